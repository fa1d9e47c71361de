"""Benchmarks of the voxel engine: a synthetic building, the cases that are timed in it, and the tables they end in."""
