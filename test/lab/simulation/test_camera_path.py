import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_core.frame import check_pose
from fus3dmaps_lab.simulation.camera_path import CameraPath, Viewpoint, look_at

LOOP = [
    Viewpoint((1.0, 0.0, 1.2), (3.0, 0.0, 1.0)),
    Viewpoint((0.0, 1.0, 1.3), (0.0, 3.0, 1.0)),
    Viewpoint((-1.0, 0.0, 1.2), (-3.0, 0.0, 1.4)),
    Viewpoint((0.0, -1.0, 1.1), (0.0, -3.0, 1.0)),
]
POINTS = st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(0, 3))


@given(POINTS, POINTS)
def test_a_view_is_rigid_upright_and_centred_on_its_target(position, target):
    offset = np.subtract(target, position)
    if np.hypot(offset[0], offset[1]) < 1e-3:
        return
    pose = look_at(position, target)
    check_pose(pose)
    seen = pose[:3, :3].T @ offset
    np.testing.assert_allclose(seen, (0, 0, np.linalg.norm(offset)), atol=1e-9)
    assert pose[2, 0] == pytest.approx(0, abs=1e-12)  # The image's rows are level ...
    assert pose[2, 1] < 0  # ... and its columns run downwards.


def test_a_view_straight_up_or_of_itself_is_refused():
    for target in ((0, 0, 5), (0, 0, 1)):
        with pytest.raises(ValueError, match="no upright view"):
            look_at((0, 0, 1), target)


def test_the_path_passes_through_every_viewpoint_and_returns():
    path = CameraPath(LOOP)
    poses = np.stack([path.pose(s) for s in np.linspace(0, 1, 4001)])
    for view in LOOP:
        gap = np.linalg.norm(poses[:, :3, 3] - view.position_m, axis=1)
        nearest = poses[np.argmin(gap)]
        assert gap.min() < 2e-3
        forward = np.subtract(view.target_m, view.position_m)
        assert nearest[:3, 2] @ forward / np.linalg.norm(forward) > 1 - 1e-5
    np.testing.assert_allclose(path.pose(0.0), path.pose(1.0), atol=1e-9)


@pytest.mark.parametrize("metres_per_radian", [0.5, 1.0, 2.0])
def test_steps_are_even_and_the_path_has_no_kink(metres_per_radian):
    path = CameraPath(LOOP, metres_per_radian)
    poses = np.stack([path.pose(s) for s in np.linspace(0, 1, 201)])
    moved = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turned = np.arccos(np.clip(np.sum(poses[1:, :3, 2] * poses[:-1, :3, 2], axis=1), -1, 1))
    step = np.hypot(moved, metres_per_radian * turned)
    assert step.max() / step.min() < 1.02
    velocity = np.diff(poses[:, :3, 3], axis=0)
    assert np.linalg.norm(np.diff(velocity, axis=0), axis=1).max() < 0.2 * moved.max()


def test_a_loop_needs_three_viewpoints():
    with pytest.raises(ValueError, match="three viewpoints, got 2"):
        CameraPath(LOOP[:2])
