"""ROS messages without ROS: the topic table, CDR encoding and decoding, and the step's messages."""
