"""Pinhole geometry, keyframe gates and trajectories."""
