"""Generators of the tables and pages of the documentation."""
