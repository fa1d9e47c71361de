"""Simulated rooms and buildings, a depth sensor, a drifting robot, and models that err with stated statistics."""
