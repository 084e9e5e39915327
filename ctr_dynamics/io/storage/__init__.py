"""Files that hold recorded messages: MCAP, SQLite and ROS 1 bags, one interface for all."""
