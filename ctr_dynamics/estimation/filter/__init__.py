"""The filter: a reduced-rank extended Kalman filter on the fields of the rod. Begin with ``ekf.py``."""
