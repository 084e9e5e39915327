"""ROS 2 nodes: the estimator and a driver that plays a bag; the only place, with `messages`, that knows ROS."""
