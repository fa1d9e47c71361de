"""Open-vocabulary 3D mapping: one voxel map, a dense and an instance layer, and their fusion. Imports no ROS."""

__version__ = "0.1.0"
