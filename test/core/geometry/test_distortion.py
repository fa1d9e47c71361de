"""Rectification against the lens models written out plainly: where a known ray is seen before, it must be seen after."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_core.errors import FrameError
from fus3dmaps_core.frame import Intrinsics
from fus3dmaps_core.geometry.distortion import Distortion, Rectifier

CAMERA = Intrinsics(140.0, 150.0, 81.3, 57.8, 160, 120)
LENSES = {
    "barrel": Distortion("plumb_bob", (-0.28, 0.09, 0.002, -0.0015, -0.01)),
    "pincushion": Distortion("plumb_bob", (0.15, 0.05, -0.001, 0.002)),
    "rational": Distortion("rational_polynomial", (0.5, -2.6, 0.0005, -0.0003, 1.5, 0.4, -2.4, 1.45)),
    "prism": Distortion("rational_polynomial", (-0.1, 0.02, 0.001, 0.002, 0, 0.05, 0.01, 0, 0.01, -0.004, 0.006, 0.002)),
    "tilted": Distortion("rational_polynomial", (-0.1, 0.02, 0.001, 0, 0, 0.05, 0, 0, 0.01, 0, 0.006, 0, 0.03, -0.05)),
    "fisheye": Distortion("equidistant", (-0.02, 0.01, -0.003, 0.0005)),
}  # fmt: skip
RAYS = [(0.0, 0.0), (0.21, -0.13), (-0.33, 0.24), (0.38, 0.29), (-0.4, -0.3)]


def distorted(x: float, y: float, lens: Distortion) -> tuple[float, float]:
    """Move the ray (x, y, 1) as a lens does."""
    if lens.model == "equidistant":
        radius = np.hypot(x, y)
        if radius == 0:
            return x, y
        theta = np.arctan(radius)
        bent = theta + sum(k * theta ** (3 + 2 * i) for i, k in enumerate(lens.coefficients))
        return x * bent / radius, y * bent / radius
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4, tilt_x, tilt_y = (*lens.coefficients, *[0.0] * 14)[:14]
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    bent_x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + s1 * r2 + s2 * r2**2
    bent_y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + s3 * r2 + s4 * r2**2
    about_x = np.array([[1, 0, 0], [0, np.cos(tilt_x), np.sin(tilt_x)], [0, -np.sin(tilt_x), np.cos(tilt_x)]])
    about_y = np.array([[np.cos(tilt_y), 0, -np.sin(tilt_y)], [0, 1, 0], [np.sin(tilt_y), 0, np.cos(tilt_y)]])
    R = about_y @ about_x
    sensor = np.array([[R[2, 2], 0, -R[0, 2]], [0, R[2, 2], -R[1, 2]], [0, 0, 1]]) @ R @ (bent_x, bent_y, 1)
    return sensor[0] / sensor[2], sensor[1] / sensor[2]


def pixel(x: float, y: float, camera: Intrinsics) -> tuple[float, float]:
    return camera.fx * x + camera.cx, camera.fy * y + camera.cy


def sources(lens: Distortion, camera: Intrinsics) -> np.ndarray:
    """Find for each pixel of the pinhole camera where the lens shows its ray, (H, W, 2) column and row."""
    return np.array(
        [
            [
                pixel(*distorted((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, lens), camera)
                for u in range(camera.width)
            ]
            for v in range(camera.height)
        ]
    )


@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("ray", RAYS)
def test_a_blob_lands_where_the_pinhole_camera_sees_it(name, ray):
    u, v = pixel(*distorted(*ray, LENSES[name]), CAMERA)
    rows, columns = np.mgrid[: CAMERA.height, : CAMERA.width]
    blob = 250 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * 1.8**2))
    image = np.stack([blob, blob, np.zeros_like(blob)], axis=2).round().astype(np.uint8)
    rectified = Rectifier(CAMERA, LENSES[name]).color(image)
    assert rectified.shape == image.shape
    assert rectified.dtype == np.uint8
    assert rectified[:, :, 2].max() == 0
    weight = rectified[:, :, 0].astype(float)
    u_true, v_true = pixel(*ray, CAMERA)
    assert (weight * columns).sum() / weight.sum() == pytest.approx(u_true, abs=0.12)
    assert (weight * rows).sum() / weight.sum() == pytest.approx(v_true, abs=0.12)


@pytest.mark.parametrize("name", LENSES)
def test_depth_is_the_nearest_reading_of_the_ray_and_0_outside(name, rng):
    depth_m = rng.uniform(0.5, 5.0, (CAMERA.height, CAMERA.width)).astype(np.float32)
    depth_m[40, 70], depth_m[41, 70] = np.nan, 0.0
    rectified = Rectifier(CAMERA, LENSES[name]).depth(depth_m)
    where = sources(LENSES[name], CAMERA)
    nearest = np.rint(where).astype(int)
    inside = ((nearest >= 0) & (nearest < (CAMERA.width, CAMERA.height))).all(axis=2)
    column, row = np.clip(nearest[..., 0], 0, CAMERA.width - 1), np.clip(nearest[..., 1], 0, CAMERA.height - 1)
    expected = np.where(inside, depth_m[row, column], np.float32(0))
    # On the line between two pixels either is the nearest.
    clear = (np.abs(where - np.floor(where) - 0.5) > 1e-3).all(axis=2)
    assert clear.mean() > 0.99
    assert rectified.dtype == np.float32
    np.testing.assert_array_equal(rectified[clear], expected[clear])


def test_depth_is_never_mixed_across_an_edge():
    depth_m = np.full((CAMERA.height, CAMERA.width), 1.0, np.float32)
    depth_m[:, 90:] = 4.0
    assert set(np.unique(Rectifier(CAMERA, LENSES["barrel"]).depth(depth_m))) <= {0.0, 1.0, 4.0}


@pytest.mark.parametrize(
    "lens", [Distortion("plumb_bob", (-0.9, 0.0, 0.0, 0.0, 0.0)), Distortion("equidistant", (-0.9, 0.0, 0.0, 0.0))]
)
def test_where_the_model_folds_nothing_is_shown(lens):
    """r (1 - 0.9 r^2) and its like turn back at r = 0.61: farther rays would show the middle again."""
    wide = Intrinsics(60.0, 60.0, 79.5, 59.5, 160, 120)
    rectified = Rectifier(wide, lens).depth(np.ones((120, 160), np.float32))
    radius = np.hypot(*np.meshgrid((np.arange(160) - 79.5) / 60, (np.arange(120) - 59.5) / 60))
    bend = np.sqrt(1 / 2.7)
    turn = bend if lens.model == "plumb_bob" else np.tan(bend)
    assert not rectified[radius > turn + 0.02].any()
    assert rectified[radius < turn - 0.02].all()


@pytest.mark.parametrize(
    ("model", "coefficients", "message"),
    [
        ("kannala", (0.1,) * 4, "unknown distortion model 'kannala'"),
        ("", (0.1,) * 5, "unknown distortion model ''"),
        ("plumb_bob", (0.1,) * 3, "takes 4 or 5"),
        ("plumb_bob", (0.1,) * 8, "takes 4 or 5"),
        ("rational_polynomial", (0.1,) * 5, "takes 8 or 12 or 14"),
        ("equidistant", (0.1,) * 5, "takes 4 finite"),
        ("equidistant", (0.1, 0.1, np.nan, 0.1), "takes 4 finite"),
    ],
)
def test_distortion_that_is_none_is_refused(model, coefficients, message):
    with pytest.raises(FrameError, match=message) as caught:
        Distortion(model, coefficients)
    assert caught.value.reason == "bad_intrinsics"


def test_images_of_another_size_are_refused():
    rectifier = Rectifier(CAMERA, LENSES["barrel"])
    for call in (
        lambda: rectifier.color(np.zeros((120, 161, 3), np.uint8)),
        lambda: rectifier.depth(np.zeros((121, 160), np.float32)),
    ):
        with pytest.raises(FrameError, match="160x120") as caught:
            call()
        assert caught.value.reason == "size_mismatch"


@given(
    st.sampled_from(["plumb_bob", "rational_polynomial", "equidistant"]),
    st.lists(st.floats(-1e6, 1e6), min_size=8, max_size=8),
)
def test_any_finite_coefficients_give_readings_of_the_image_or_0(model, values):
    count = {"plumb_bob": 5, "rational_polynomial": 8, "equidistant": 4}[model]
    camera = Intrinsics(20.0, 20.0, 9.5, 7.5, 20, 16)
    depth_m = np.arange(1, 321, dtype=np.float32).reshape(16, 20)
    rectified = Rectifier(camera, Distortion(model, tuple(values[:count]))).depth(depth_m)
    assert np.isin(rectified, [0, *depth_m.ravel()]).all()
