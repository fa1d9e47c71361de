"""The thin ROS 2 shell around fus3dmaps_core: parameters, topics, services and the command line."""
