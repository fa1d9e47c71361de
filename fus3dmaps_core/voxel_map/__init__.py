"""The map: one voxel hash under a dense layer and an instance layer."""
