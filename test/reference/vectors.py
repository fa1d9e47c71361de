"""Vector arithmetic every part of the reference needs."""

from __future__ import annotations

import math

import numpy as np

Vector = np.ndarray
Key = tuple[int, int, int]


def unit(vector: Vector) -> Vector:
    """The vector at length one, float64."""
    vector = np.asarray(vector, dtype=np.float64)
    return vector / math.sqrt(float(np.dot(vector, vector)))


def cosine(a: Vector, b: Vector) -> float:
    """Cosine of the angle between two vectors; 0 where one has no direction."""
    length = math.sqrt(float(np.dot(a, a))) * math.sqrt(float(np.dot(b, b)))
    return float(np.dot(a, b)) / length if length > 0 else 0.0


def voxel_of(point_m: Vector, voxel_size_m: float) -> Key:
    """Voxel that holds a point: floor(p / size) per axis."""
    x, y, z = (math.floor(float(value) / voxel_size_m) for value in point_m)
    return x, y, z


def center_of(key: Key, voxel_size_m: float) -> Vector:
    """Centre of a voxel, metres."""
    return (np.array(key, dtype=np.float64) + 0.5) * voxel_size_m
