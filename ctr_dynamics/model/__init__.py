"""The dynamic model of a concentric tube robot: equations, meshes, statics, time stepping and tangents. No clock, no ROS."""
