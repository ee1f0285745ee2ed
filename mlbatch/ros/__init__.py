"""ROS messages: definitions, encodings, and the types that are read or written."""
