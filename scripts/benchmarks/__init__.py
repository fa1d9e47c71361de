"""Benchmarks of the voxel engine: a synthetic building, the cases that are timed in it, and the tables they end in."""

import fus3dmaps_core as _before_torch  # Sets how long torch's idle threads spin, which torch reads when it is imported.

__all__: list[str] = []
del _before_torch
