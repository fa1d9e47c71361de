"""Drift grows as stated."""

from __future__ import annotations

import numpy as np

from fus3dmaps_lab.simulation.drift import Drift


def straight_way(length_m: float, steps: int) -> np.ndarray:
    poses = np.tile(np.eye(4), (steps + 1, 1, 1))
    poses[:, 0, 3] = np.linspace(0, length_m, steps + 1)
    return poses


def test_position_strays_with_the_square_root_of_the_way() -> None:
    way = straight_way(9.0, 90)
    ends = np.array([Drift(0.01, 0.0, seed).believed(way)[-1, :3, 3] for seed in range(400)])
    np.testing.assert_allclose(ends.mean(axis=0), way[-1, :3, 3], atol=4 * 0.03 / 20)
    np.testing.assert_allclose(ends.std(axis=0), 0.03, rtol=0.15)


def test_heading_strays_with_way_and_turning() -> None:
    way = straight_way(4.0, 40)
    ends = np.array([Drift(0.0, 0.01, seed).believed(way)[-1] for seed in range(400)])
    np.testing.assert_allclose(np.arctan2(ends[:, 1, 0], ends[:, 0, 0]).std(), 0.02, rtol=0.15)


def test_poses_stay_rigid_and_start_true() -> None:
    way = straight_way(5.0, 500)
    believed = Drift(0.05, 0.05, 1).believed(way)
    np.testing.assert_array_equal(believed[0], way[0])
    R = believed[:, :3, :3]
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), np.tile(np.eye(3), (501, 1, 1)), atol=1e-9)
    np.testing.assert_array_equal(Drift(0.0, 0.0).believed(way)[-1].round(12), way[-1].round(12))
