"""The voxel hash."""
