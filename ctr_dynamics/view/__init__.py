"""What RViz and Foxglove show: the tubes as markers, and a server for Foxglove. No ROS is needed."""
