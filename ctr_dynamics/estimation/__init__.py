"""The estimator: filter, late inputs and monitoring of one robot. Begin with ``estimator.py``; docs/filter.md explains the method."""
