"""Monitoring: counters, statuses for /diagnostics, the consistency monitor with likely causes, and the log of innovations."""
