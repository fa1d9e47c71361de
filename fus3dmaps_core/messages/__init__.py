"""Decoding of ROS messages, without ROS."""
