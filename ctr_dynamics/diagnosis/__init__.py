"""Diagnosis: from measured bags to what the simulation gets wrong, its cause, and what the extended model gains."""
