"""Performance figures: costs of sweeps and steps, real-time ratios, tick times, and errors in time and space."""
