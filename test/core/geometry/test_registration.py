"""Registration against rays cast plainly into known scenes, and what holds of any depth image."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from fus3dmaps_core.errors import FrameError
from fus3dmaps_core.frame import Intrinsics
from fus3dmaps_core.geometry.registration import register_depth

DEPTH = Intrinsics(90.0, 92.0, 48.7, 35.2, 100, 72)
CAMERAS = {
    "same": DEPTH,
    "finer": Intrinsics(230.0, 228.0, 129.0, 88.5, 256, 180),
    "coarser": Intrinsics(40.0, 41.0, 19.8, 15.1, 40, 30),
    "narrower": Intrinsics(200.0, 200.0, 59.5, 39.5, 120, 80),
}
POSES = {
    "beside": ((0.05, 0.0, 0.0), (0.0, 0.0, 0.0)),
    "ahead": ((0.0, -0.01, -0.3), (0.0, 0.0, 0.0)),
    "turned": ((-0.04, 0.02, 0.01), (0.05, -0.12, 0.0)),
    "rolled": ((0.01, 0.0, 0.0), (0.02, 0.03, 0.7)),
}


def transform(translation, rotation_vector=(0.0, 0.0, 0.0)) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotation_vector).as_matrix()
    T[:3, 3] = translation
    return T


class Plane:
    """Points p with normal . p = distance in the depth camera's frame, where columns of the wall lie within x limits."""

    def __init__(self, normal, distance, x_from=-np.inf, x_to=np.inf):
        self.normal, self.distance, self.x_from, self.x_to = np.array(normal, float), distance, x_from, x_to

    def hit(self, origin: np.ndarray, direction: np.ndarray) -> float:
        """Return how many directions away from the origin the plane is; inf if it is not met."""
        across = self.normal @ direction
        along = (self.distance - self.normal @ origin) / across if across else np.inf
        x = origin[0] + along * direction[0] if np.isfinite(along) else np.nan
        return along if along > 0 and self.x_from <= x < self.x_to else np.inf


def cast(planes, camera: Intrinsics, T_depth_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cast rays: depth along the axis at every pixel, 0 where nothing is met, and the points in the depth camera's frame."""
    depth, points = np.zeros((camera.height, camera.width)), np.full((camera.height, camera.width, 3), np.nan)
    origin = T_depth_camera[:3, 3]
    for v in range(camera.height):
        for u in range(camera.width):
            # Of length 1 along the axis, so that what is counted in directions is depth.
            direction = T_depth_camera[:3, :3] @ ((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0)
            nearest = min(plane.hit(origin, direction) for plane in planes)
            if np.isfinite(nearest):
                depth[v, u], points[v, u] = nearest, origin + nearest * direction
    return depth, points


def seen_by_depth_camera(points: np.ndarray, margin: float) -> np.ndarray:
    """Tell which points lie inside the depth camera's image, by a margin of pixels."""
    u = DEPTH.fx * points[..., 0] / points[..., 2] + DEPTH.cx
    v = DEPTH.fy * points[..., 1] / points[..., 2] + DEPTH.cy
    return (u > margin) & (u < DEPTH.width - 1 - margin) & (v > margin) & (v < DEPTH.height - 1 - margin)


def registered(planes, camera: Intrinsics, T: np.ndarray) -> np.ndarray:
    depth_m = cast(planes, DEPTH, np.eye(4))[0].astype(np.float32)
    return register_depth(depth_m, DEPTH, camera, T)


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("pose", POSES)
def test_a_plane_without_holes(camera, pose):
    T = transform(*POSES[pose])
    wall = Plane((0.25, -0.1, 1.0), 2.0)
    found = registered([wall], CAMERAS[camera], T)
    expected, points = cast([wall], CAMERAS[camera], np.linalg.inv(T))
    assert found.shape == expected.shape
    assert found.dtype == np.float32
    inside = seen_by_depth_camera(points, margin=1.0)
    assert inside.sum() > 300
    assert (found[inside] > 0).all()
    # A patch is as deep as its centre: half a pixel of either camera, on this slope, is the error.
    half_pixels_m = 2.2 * 0.75 * (1.2 / min(DEPTH.fx, DEPTH.fy) + 1.2 / min(CAMERAS[camera].fx, CAMERAS[camera].fy)) * 0.6
    assert np.abs(found - expected)[inside].max() < half_pixels_m
    assert np.abs((found - expected)[inside].mean()) < half_pixels_m / 2
    assert not found[~seen_by_depth_camera(points, margin=-2.0)].any()


@pytest.mark.parametrize("camera", CAMERAS)
def test_what_is_near_hides_what_is_far(camera):
    """A post before a wall, seen from 30 cm to the side: no wall shines through it, and what it hid stays empty."""
    T = transform((0.3, 0.0, 0.0))
    wall, post = Plane((0, 0, 1), 3.0), Plane((0, 0, 1), 1.0, -0.2, 0.15)
    rgb = CAMERAS[camera]
    found = registered([wall, post], rgb, T)
    expected, points = cast([wall, post], rgb, np.linalg.inv(T))
    seen = seen_by_depth_camera(points, margin=1.0)
    assert set(np.unique(found)) <= {0.0, 1.0, 3.0}
    # What the post hides from the depth camera, though the colour camera sees the wall there.
    x_at_post = points[..., 0] / points[..., 2]
    hidden = (expected == 3.0) & (x_at_post > -0.2) & (x_at_post < 0.15)
    edge_m = 1.5 / DEPTH.fx  # Half a pixel of either camera is where an edge may lie.
    to_edges = np.min([np.abs(x_at_post + 0.2), np.abs(x_at_post - 0.15)], axis=0)
    clear = seen & (to_edges > edge_m) & away_from_steps(expected, 1 + int(np.ceil(rgb.fx / DEPTH.fx)))
    assert (clear & hidden).sum() > 20
    assert (clear & ~hidden & (expected == 1.0)).sum() > 50
    assert (clear & ~hidden & (expected == 3.0)).sum() > 50
    np.testing.assert_array_equal(found[clear & ~hidden], expected[clear & ~hidden].astype(np.float32))
    assert not found[clear & hidden].any()


def away_from_steps(depth: np.ndarray, pixels: int) -> np.ndarray:
    """Tell which pixels have the same depth so many pixels to the left and right."""
    padded = np.pad(depth, ((0, 0), (pixels, pixels)), mode="edge")
    shifts = [padded[:, i : i + depth.shape[1]] for i in range(2 * pixels + 1)]
    return np.all([np.isclose(shift, depth) for shift in shifts], axis=0)


def test_the_same_camera_gives_the_same_image(rng):
    depth_m = rng.uniform(0.2, 8.0, (DEPTH.height, DEPTH.width)).astype(np.float32)
    depth_m[rng.random(depth_m.shape) < 0.2] = 0
    kept = depth_m.copy()
    np.testing.assert_array_equal(register_depth(depth_m, DEPTH, DEPTH, np.eye(4)), depth_m)
    np.testing.assert_array_equal(depth_m, kept)


def test_a_whole_multiple_of_the_size_repeats_readings(rng):
    depth_m = rng.uniform(0.2, 8.0, (DEPTH.height, DEPTH.width)).astype(np.float32)
    finer = DEPTH.resized(3 * DEPTH.width, 3 * DEPTH.height)
    np.testing.assert_array_equal(register_depth(depth_m, DEPTH, finer, np.eye(4)), np.kron(depth_m, np.ones((3, 3))))


def test_one_reading_worked_out_by_hand():
    """The pixel at the centre, 2 m away, from a camera half a metre farther back: 2.5 m, and 0.25 m to the right 0.1 f."""
    depth_m = np.zeros((3, 3), np.float32)
    depth_m[1, 1] = 2.0
    found = register_depth(
        depth_m, Intrinsics(10, 10, 1, 1, 3, 3), Intrinsics(10, 10, 1, 1, 3, 3), transform((0.25, 0.0, 0.5))
    )
    assert found.tolist() == [[0, 0, 0], [0, 0, 2.5], [0, 0, 0]]


@pytest.mark.parametrize("nothing", [0.0, np.nan, np.inf, -np.inf, -1.0])
def test_what_is_no_reading_is_left_out(nothing):
    depth_m = np.full((DEPTH.height, DEPTH.width), nothing, np.float32)
    assert not register_depth(depth_m, DEPTH, CAMERAS["finer"], transform((0.1, 0, 0))).any()
    depth_m[30, 40] = 1.5
    found = register_depth(depth_m, DEPTH, CAMERAS["finer"], transform((0.1, 0, 0)))
    assert set(np.unique(found)) == {0.0, 1.5}


def test_what_lies_behind_the_colour_camera_is_left_out():
    depth_m = np.full((DEPTH.height, DEPTH.width), 1.0, np.float32)
    assert not register_depth(depth_m, DEPTH, DEPTH, transform((0, 0, -1.5))).any()
    assert not register_depth(depth_m, DEPTH, DEPTH, transform((0, 0, 0), (0, np.pi, 0))).any()


def test_a_wrong_size_or_transform_is_refused():
    with pytest.raises(FrameError, match="100x72") as caught:
        register_depth(np.zeros((72, 99), np.float32), DEPTH, DEPTH, np.eye(4))
    assert caught.value.reason == "size_mismatch"
    with pytest.raises(FrameError) as caught:
        register_depth(np.zeros((72, 100), np.float32), DEPTH, DEPTH, np.full((4, 4), np.nan))
    assert caught.value.reason == "bad_pose"


@settings(max_examples=80)
@given(
    arrays(np.float32, (6, 8), elements=st.floats(width=32)),
    st.tuples(*[st.floats(-2, 2)] * 3),
    st.tuples(*[st.floats(-3, 3)] * 3),
    st.sampled_from([(8, 6, 7.0), (31, 17, 25.0), (3, 2, 2.0)]),
)
def test_any_depth_gives_a_subset_of_the_moved_readings(depth_m, translation, rotation_vector, size):
    width, height, focal = size
    small = Intrinsics(7.0, 7.5, 3.4, 2.6, 8, 6)
    T = transform(translation, rotation_vector)
    found = register_depth(depth_m, small, Intrinsics(focal, focal, width / 2, height / 2, width, height), T)
    moved = [0.0]
    for (v, u), z in np.ndenumerate(depth_m.astype(float)):
        if np.isfinite(z) and z > 0:
            moved.append((T @ (z * (u - small.cx) / small.fx, z * (v - small.cy) / small.fy, z, 1))[2])
    assert found.shape == (height, width)
    for value in np.unique(found):
        scale = max(1.0, float(depth_m[np.isfinite(depth_m)].max(initial=0)))
        assert np.min(np.abs(np.array(moved) - value)) <= 1e-5 * scale
