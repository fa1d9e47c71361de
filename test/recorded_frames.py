"""Small posed frames of noise, and the 7-Scenes folder that holds them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from fus3dmaps_core.frame import Intrinsics, PosedFrame

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 100_000_000


def noise_frames(count: int, width: int = 160, height: int = 120, seed: int = 7) -> list[PosedFrame]:
    """Frames of incompressible colours and whole millimetres, some without a reading, on a curved path."""
    rng = np.random.default_rng(seed)
    frames = []
    for i in range(count):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec([0.1 * i, 0.02 * i, -0.05 * i]).as_matrix()
        T[:3, 3] = [0.1 * i, np.sin(i), 1.0]
        depth_mm = rng.integers(1, 6000, (height, width))
        depth_mm[rng.random((height, width)) < 0.1] = 0
        frames.append(
            PosedFrame(
                START_NS + i * PERIOD_NS,
                rng.integers(0, 256, (height, width, 3), dtype=np.uint8),
                (depth_mm * 0.001).astype(np.float32),
                Intrinsics(150.0, 151.0, 79.5, 60.25, width, height),
                T,
            )
        )
    return frames


def assert_same_frames(actual: list[PosedFrame], expected: list[PosedFrame]) -> None:
    assert [frame.stamp_ns for frame in actual] == [frame.stamp_ns for frame in expected]
    for a, e in zip(actual, expected, strict=True):
        np.testing.assert_array_equal(a.rgb, e.rgb)
        np.testing.assert_array_equal(np.rint(a.depth_m * 1000), np.rint(e.depth_m * 1000))
        np.testing.assert_allclose(a.T_world_camera, e.T_world_camera, atol=1e-12)
        assert a.intrinsics == e.intrinsics


def write_sevenscenes(directory: Path, frames: list[PosedFrame], numbers: list[int], suffix: str = "png") -> None:
    """Lay frames out as the dataset does: 65535 where there is no reading, poses as text, no file of intrinsics."""
    directory.mkdir(parents=True, exist_ok=True)
    for number, frame in zip(numbers, frames, strict=True):
        stem = str(directory / f"frame-{number:06d}")
        cv2.imwrite(f"{stem}.color.{suffix}", frame.rgb[:, :, ::-1])
        depth_mm = np.rint(frame.depth_m * 1000).astype(np.uint16)
        cv2.imwrite(f"{stem}.depth.png", np.where(depth_mm == 0, 65535, depth_mm).astype(np.uint16))
        rows = "\n".join("\t".join(f"{value: .7e}" for value in row) + "\t " for row in frame.T_world_camera)
        Path(f"{stem}.pose.txt").write_text(rows + "\n")
