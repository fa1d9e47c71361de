"""Frames refuse what cannot be mapped, each with its reason."""

import numpy as np
import pytest

from fus3dmaps_core.errors import FrameError
from fus3dmaps_core.frame import Intrinsics, PosedFrame

CAMERA = Intrinsics(500.0, 510.0, 31.5, 23.5, 64, 48)


def make(**changes):
    values = {
        "stamp_ns": 1,
        "rgb": np.zeros((48, 64, 3), np.uint8),
        "depth_m": np.ones((48, 64), np.float32),
        "intrinsics": CAMERA,
        "T_world_camera": np.eye(4),
    }
    return PosedFrame(**{**values, **changes})


def test_a_good_frame_and_smaller_depth_are_taken():
    assert make().stamp_ns == 1
    assert make(depth_m=np.ones((24, 32), np.float32)).depth_m.shape == (24, 32)


mirrored = np.diag([-1.0, 1.0, 1.0, 1.0])
not_a_number = np.eye(4)
not_a_number[0, 3] = np.nan


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"rgb": np.zeros((48, 64), np.uint8)}, "bad_image"),
        ({"rgb": np.zeros((48, 64, 3), np.float32)}, "bad_image"),
        ({"rgb": np.zeros((0, 64, 3), np.uint8)}, "bad_image"),
        ({"rgb": np.zeros((48, 63, 3), np.uint8)}, "size_mismatch"),
        ({"depth_m": np.ones((48, 64))}, "bad_depth"),
        ({"depth_m": np.ones((48, 64, 1), np.float32)}, "bad_depth"),
        ({"T_world_camera": not_a_number}, "bad_pose"),
        ({"T_world_camera": mirrored}, "bad_pose"),
        ({"T_world_camera": 2 * np.eye(4)}, "bad_pose"),
        ({"T_world_camera": np.eye(3)}, "bad_pose"),
        ({"rgb": None}, "bad_image"),
        ({"depth_m": [[1.0]]}, "bad_depth"),
        ({"T_world_camera": np.eye(4).tolist()}, "bad_pose"),
    ],
)
def test_refusals_carry_their_reason(changes, reason):
    with pytest.raises(FrameError) as caught:
        make(**changes)
    assert caught.value.reason == reason


@pytest.mark.parametrize("values", [(0, 1, 1, 1, 4, 4), (1, np.nan, 1, 1, 4, 4), (1, 1, 1, 1, 0, 4), (-5, 1, 1, 1, 4, 4)])
def test_unusable_intrinsics(values):
    with pytest.raises(FrameError) as caught:
        Intrinsics(*values)
    assert caught.value.reason == "bad_intrinsics"


def test_resizing_keeps_every_ray():
    half = CAMERA.resized(32, 24)
    # The centre of a 2x2 block of pixels is the centre of the one pixel it becomes.
    for x, y in ((0, 0), (5, 7), (31, 23)):
        full = ((2 * x + 0.5 - CAMERA.cx) / CAMERA.fx, (2 * y + 0.5 - CAMERA.cy) / CAMERA.fy)
        assert full == pytest.approx(((x - half.cx) / half.fx, (y - half.cy) / half.fy))
