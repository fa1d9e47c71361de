"""Resizing, sampling and unprojection against the plain reference and known scenes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.projection import patch_of_pixel, project_point, unproject_pixel, valid_depth
from scipy.spatial.transform import Rotation

from fus3dmaps_core.config.schema import ImageConfig
from fus3dmaps_core.frame import Intrinsics, PosedFrame
from fus3dmaps_core.geometry.projection import resize_frame, sample_pattern, sample_pixels, unproject


def random_pose(rng: np.random.Generator, far_m: float = 3.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rng.normal(size=3)).as_matrix()
    T[:3, 3] = rng.normal(size=3) * far_m
    return T


def posed(depth_m: np.ndarray, rgb: np.ndarray | None = None, intrinsics: Intrinsics | None = None) -> PosedFrame:
    height, width = depth_m.shape
    rgb = np.zeros((height, width, 3), np.uint8) if rgb is None else rgb
    intrinsics = intrinsics or Intrinsics(0.9 * width, 0.95 * width, width / 2 - 0.3, height / 2 - 0.9, width, height)
    return PosedFrame(0, rgb, depth_m.astype(np.float32), intrinsics, np.eye(4))


# ---- unprojection


@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(1, 30))
def test_pixels_become_the_points_of_the_reference(seed: int, count: int):
    rng = np.random.default_rng(seed)
    height, width = int(rng.integers(2, 50)), int(rng.integers(2, 50))
    camera = Intrinsics(*rng.uniform(10, 600, 2), *rng.uniform(-5, 55, 2), width, height)
    depth = rng.uniform(0.1, 6.0, (height, width)).astype(np.float32)
    T = random_pose(rng, far_m=1e4)
    ys, xs = rng.integers(0, height, count), rng.integers(0, width, count)
    got = unproject(depth, ys, xs, camera, T)
    assert got.dtype == np.float64
    expected = [unproject_pixel(x, y, float(depth[y, x]), camera.matrix, T) for y, x in zip(ys, xs, strict=True)]
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-8)


def test_a_known_pixel_of_a_known_camera():
    """Optical frame: x right, y down, z forward. The camera looks along the map's x, its right is the map's -y."""
    T = np.array([[0, 0, 1, 10], [-1, 0, 0, 20], [0, -1, 0, 30], [0, 0, 0, 1]], float)
    camera = Intrinsics(100.0, 50.0, 4.0, 3.0, 9, 7)
    depth = np.full((7, 9), 2.0, np.float32)
    # Four pixels right of the axis: 4 / 100 * 2 m; three above it: 3 / 50 * 2 m.
    got = unproject(depth, np.array([3, 0]), np.array([4, 8]), camera, T)
    np.testing.assert_allclose(got, [[12, 20, 30], [12, 20 - 0.08, 30 + 0.12]], atol=1e-12)


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_points_project_back_to_their_pixels(seed: int):
    rng = np.random.default_rng(seed)
    camera = Intrinsics(500.0, 510.0, 320.5, 238.0, 640, 480)
    depth = rng.uniform(0.2, 6.0, (480, 640)).astype(np.float32)
    ys, xs, T = rng.integers(0, 480, 20), rng.integers(0, 640, 20), random_pose(rng)
    for point, y, x in zip(unproject(depth, ys, xs, camera, T), ys, xs, strict=True):
        np.testing.assert_allclose(project_point(point, camera.matrix, T), (x, y, depth[y, x]), atol=1e-5)


def test_pixels_without_depth_are_the_callers_to_leave_out_and_no_pixel_is_no_point():
    camera = Intrinsics(10.0, 10.0, 2.0, 2.0, 4, 4)
    nothing = np.zeros(0, np.int64)
    assert unproject(np.ones((4, 4), np.float32), nothing, nothing, camera, np.eye(4)).shape == (0, 3)


# ---- sampling


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6, 7, 8, 9, 16, 25, 60, 256])
def test_a_pattern_has_its_points_apart_and_inside_the_patch(count: int):
    pattern = sample_pattern(count)
    assert pattern.shape == (count, 2)
    assert np.all((pattern > 0) & (pattern < 1))
    assert len({tuple(point) for point in pattern.tolist()}) == count
    np.testing.assert_array_equal(pattern, sample_pattern(count))


def test_five_are_a_quincunx():
    points = {tuple(point) for point in sample_pattern(5).round(9).tolist()}
    assert (0.5, 0.5) in points
    (low, high) = sorted({y for y, _ in points} - {0.5})
    assert points == {(0.5, 0.5), (low, low), (low, high), (high, low), (high, high)}
    assert low + high == pytest.approx(1.0)


@pytest.mark.parametrize("edge", [1, 2, 3, 4, 5, 16])
def test_squares_are_a_regular_grid_of_cell_centres(edge: int):
    centres = (np.arange(edge) + 0.5) / edge
    expected = sorted((y, x) for y in centres for x in centres)
    np.testing.assert_allclose(sorted(map(tuple, sample_pattern(edge * edge).tolist())), expected, atol=1e-12)


grids = st.tuples(
    st.integers(16, 200), st.integers(16, 200), st.integers(1, 16), st.integers(1, 16), st.sampled_from([1, 3, 4, 5, 9])
)


@given(grids)
def test_every_patch_gets_its_pixels_and_they_lie_in_it(grid: tuple[int, int, int, int, int]):
    height, width, rows, columns, per_patch = grid
    samples = sample_pixels(height, width, rows, columns, per_patch)
    assert len(samples.ys) == len(samples.xs) == len(samples.patches)
    assert samples.ys.dtype == samples.xs.dtype == samples.patches.dtype == np.int64
    assert samples.ys.min() >= 0
    assert samples.ys.max() < height
    assert samples.xs.min() >= 0
    assert samples.xs.max() < width
    np.testing.assert_array_equal(np.bincount(samples.patches, minlength=rows * columns), per_patch)
    if height % rows == 0 and width % columns == 0:
        patches = [patch_of_pixel(x, y, width, height, columns, rows) for y, x in zip(samples.ys, samples.xs, strict=True)]
        np.testing.assert_array_equal(samples.patches, patches)
    else:
        # A pixel that straddles two patches may count for either: its own span reaches into its patch.
        row, column = samples.patches // columns, samples.patches % columns
        assert np.all(samples.ys + 1 > row * height / rows)
        assert np.all(samples.ys < (row + 1) * height / rows)
        assert np.all(samples.xs + 1 > column * width / columns)
        assert np.all(samples.xs < (column + 1) * width / columns)


@pytest.mark.parametrize("per_patch", [5, 9])
def test_the_pixels_of_a_patch_differ_at_the_working_resolution(per_patch: int):
    """With patches of 16 x 16 pixels no pixel is sampled twice, and the same ones each time."""
    samples = sample_pixels(480, 640, 30, 40, per_patch)
    pixels = samples.ys * 640 + samples.xs
    assert len(np.unique(pixels)) == len(pixels) == 30 * 40 * per_patch
    again = sample_pixels(480, 640, 30, 40, per_patch)
    np.testing.assert_array_equal(pixels, again.ys * 640 + again.xs)


# ---- resizing


@settings(max_examples=30)
@given(st.lists(st.floats(width=32, allow_nan=True, allow_infinity=True), min_size=1, max_size=30))
def test_only_usable_depth_is_left(readings: list[float]):
    edges = [0.0, -1.0, 0.5, 4.0, np.nan, np.inf, -np.inf, np.nextafter(np.float32(4), np.float32(5))]
    values = np.zeros((32, 32), np.float32)
    values.flat[: len(readings) + len(edges)] = readings + edges
    image = ImageConfig(width=32, height=32, depth_min_m=0.5, depth_max_m=4.0)
    got = resize_frame(posed(values), image).depth_m
    assert got.dtype == np.float32
    expected = [value if valid_depth(float(value), 0.5, 4.0) else 0.0 for value in values.flat]
    np.testing.assert_array_equal(got.flat, np.array(expected, np.float32))


def test_a_minimum_of_zero_still_refuses_zero():
    image = ImageConfig(width=32, height=32, depth_min_m=0.0)
    depth = np.zeros((32, 32), np.float32)
    depth[0, 0] = 1e-3
    got = resize_frame(posed(depth), image).depth_m
    assert (got > 0).sum() == 1
    assert np.isfinite(got).all()


def test_a_frame_of_the_working_size_is_not_resampled():
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
    frame = posed(rng.uniform(0.5, 5, (48, 64)), rgb)
    working = resize_frame(frame, ImageConfig(width=64, height=48))
    np.testing.assert_array_equal(working.rgb, rgb)
    np.testing.assert_array_equal(working.depth_m, frame.depth_m)
    assert (working.intrinsics.width, working.intrinsics.height) == (64, 48)
    np.testing.assert_allclose(working.intrinsics.matrix, frame.intrinsics.matrix, rtol=1e-15)


@pytest.mark.parametrize("scale", [(3, 3), (3, 5), (1, 3), (5, 1)])
def test_a_shrunken_frame_unprojects_to_points_of_the_original(scale: tuple[int, int]):
    """By odd factors each new pixel's centre is an old pixel's: same ray, same depth, same point, to the micrometre."""
    factor_x, factor_y = scale
    rng = np.random.default_rng(1)
    image = ImageConfig(width=40, height=32, depth_min_m=0.0, depth_max_m=100.0)
    height, width = 32 * factor_y, 40 * factor_x
    frame = posed(rng.uniform(0.5, 5, (height, width)))
    working = resize_frame(frame, image)
    assert working.depth_m.shape == (32, 40)
    assert working.rgb.shape == (32, 40, 3)
    for y, x in ((0, 0), (31, 39), (13, 7)):
        old_y, old_x = y * factor_y + factor_y // 2, x * factor_x + factor_x // 2
        got = unproject(working.depth_m, np.array([y]), np.array([x]), working.intrinsics, np.eye(4))[0]
        expected = unproject_pixel(old_x, old_y, float(frame.depth_m[old_y, old_x]), frame.intrinsics.matrix, np.eye(4))
        np.testing.assert_allclose(got, expected, atol=1e-6)


@pytest.mark.parametrize(("height", "width"), [(480, 640), (96, 128), (47, 61), (60, 200), (968, 1296)])
def test_resizing_invents_no_depth_and_keeps_a_plane_in_place(height: int, width: int):
    """Nearest neighbour: only readings that were there, and from within half a pixel of where they are put."""
    ys, xs = np.mgrid[0:height, 0:width]
    across = ((xs + 0.5) / width).astype(np.float32)
    for depth, axis in ((1 + across, 1), (1 + ((ys + 0.5) / height).astype(np.float32), 0)):
        working = resize_frame(posed(depth), ImageConfig(width=64, height=48))
        assert set(working.depth_m.ravel().tolist()) <= set(depth.ravel().tolist())
        size, new = (width, 64) if axis == 1 else (height, 48)
        line = working.depth_m[0] if axis == 1 else working.depth_m[:, 0]
        wanted = 1 + (np.arange(new) + 0.5) / new
        assert np.abs(line - wanted).max() <= 0.5 / size + 1e-6


def test_depth_of_another_size_covers_the_same_view():
    """Colour of 128 x 96 with depth of 32 x 24: both edges of an object stay together."""
    rgb = np.zeros((96, 128, 3), np.uint8)
    rgb[:, 64:] = 255
    depth = np.full((24, 32), 1.0, np.float32)
    depth[:, 16:] = 2.0
    camera = Intrinsics(100.0, 100.0, 63.5, 47.5, 128, 96)
    working = resize_frame(PosedFrame(0, rgb, depth, camera, np.eye(4)), ImageConfig(width=64, height=48))
    assert working.depth_m.shape == (48, 64)
    np.testing.assert_array_equal(working.depth_m > 1.5, working.rgb[:, :, 0] > 127)
    assert (working.intrinsics.width, working.intrinsics.height) == (64, 48)
    np.testing.assert_allclose(working.intrinsics.matrix, [[50, 0, 31.5], [0, 50, 23.5], [0, 0, 1]])


@pytest.mark.parametrize(("height", "width"), [(96, 128), (32, 40)])
def test_colour_is_a_mean_of_what_it_covers(height: int, width: int):
    """A smooth ramp stays the ramp, whether it shrinks or grows."""
    ramp = np.linspace(20, 220, width).astype(np.uint8)
    rgb = np.repeat(np.tile(ramp, (height, 1))[:, :, None], 3, axis=2)
    working = resize_frame(posed(np.ones((height, width)), rgb), ImageConfig(width=64, height=48))
    assert working.rgb.dtype == np.uint8
    assert working.rgb.shape == (48, 64, 3)
    centres = (np.arange(64) + 0.5) / 64 * width - 0.5
    wanted = np.interp(centres, np.arange(width), ramp.astype(float))
    assert np.abs(working.rgb[20, :, 1] - wanted).max() <= 3
