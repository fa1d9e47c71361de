"""Reading and writing of rosbag2 MCAP recordings, without ROS."""
