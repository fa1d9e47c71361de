import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fus3dmaps_lab.simulation.depth_noise import DepthSensor

STEADY = DepthSensor(lateral_sigma_px=0.0, random_dropout=0.0)


def stated_sigma_m(sensor: DepthSensor, depth_m):
    return depth_m**2 / 43.5 * np.sqrt(sensor.disparity_sigma_px**2 + 0.125**2 / 12)


def wall(depth_m, shape=(240, 320)):
    return np.full(shape, depth_m, np.float32), np.ones(shape, np.float32)


@settings(max_examples=30, deadline=None)
@given(st.floats(0.6, 6.0), st.floats(0.04, 0.3))
def test_spread_of_a_wall_follows_the_stated_formula(depth_m, sigma_px):
    sensor = DepthSensor(lateral_sigma_px=0.0, random_dropout=0.0, disparity_sigma_px=sigma_px)
    readings = sensor.measure(*wall(depth_m), np.random.default_rng(3))
    expected = stated_sigma_m(sensor, depth_m)
    # How the noise falls into the steps depends on where the wall lies between them, by at most half a step.
    error = np.sqrt(np.mean((readings.astype(float) - depth_m) ** 2))
    assert 0.6 * expected < error < 1.6 * expected
    assert abs(readings.mean(dtype=float) - depth_m) < expected


def test_spread_grows_with_the_square_of_depth_averaged_over_steps():
    depths = np.linspace(1, 4, 400, dtype=np.float32)
    depth = np.repeat(depths[:, None], 500, axis=1)
    readings = DepthSensor(lateral_sigma_px=0, random_dropout=0, edge_step_px=99).measure(
        depth, np.ones_like(depth), np.random.default_rng(0)
    )
    ratio = ((readings.astype(float) - depth) / stated_sigma_m(STEADY, depth.astype(float))) ** 2
    for part in np.array_split(ratio, 4):
        assert part.mean() == pytest.approx(1.0, abs=0.05)


def test_readings_are_whole_steps_of_disparity():
    readings = STEADY.measure(*wall(1.7), np.random.default_rng(0))
    steps = 43.5 / readings.astype(float) / 0.125
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-3)


def test_grazing_surfaces_lose_their_readings_in_the_stated_share():
    depth, _ = wall(2.0)
    middle = 0.5 * (STEADY.grazing_from_rad + STEADY.grazing_to_rad)
    for angle, share in ((STEADY.grazing_from_rad - 0.01, 0.0), (middle, 0.5), (STEADY.grazing_to_rad + 0.01, 1.0)):
        readings = STEADY.measure(depth, np.full_like(depth, np.cos(angle)), np.random.default_rng(1))
        assert np.mean(readings == 0) == pytest.approx(share, abs=0.01)


def test_holes_gather_at_edges_of_depth_and_nowhere_else():
    depth, facing = wall(3.0)
    depth[:, 160:] = 1.5
    readings = STEADY.measure(depth, facing, np.random.default_rng(2))
    assert np.mean(readings[:, 159:161] == 0) == pytest.approx(0.5, abs=0.1)
    assert np.all(readings[:, :158] > 0)
    assert np.all(readings[:, 162:] > 0)


def test_edges_fray_sideways():
    depth, facing = wall(3.0)
    depth[:, 160:] = 1.5
    readings = DepthSensor(lateral_sigma_px=0.7, edge_dropout=0.0).measure(depth, facing, np.random.default_rng(2))
    assert np.any(np.abs(readings[:, 159] - 1.5) < 0.1)
    assert np.any(np.abs(readings[:, 160] - 3.0) < 0.1)
    assert np.all((np.abs(readings - 1.5) < 0.1) | (np.abs(readings - 3.0) < 0.2) | (readings == 0))


@pytest.mark.parametrize("depth_m", [0.0, 0.3, 9.0])
def test_nothing_is_read_where_there_is_nothing_or_out_of_range(depth_m):
    assert np.all(STEADY.measure(*wall(depth_m), np.random.default_rng(0)) == 0)


def test_random_holes_have_the_stated_share():
    readings = DepthSensor(random_dropout=0.05).measure(*wall(2.0), np.random.default_rng(0))
    assert np.mean(readings == 0) == pytest.approx(0.05, abs=0.005)


def test_equal_generators_give_equal_bits():
    first, second = (DepthSensor().measure(*wall(2.0), np.random.default_rng(7)) for _ in range(2))
    assert first.dtype == np.float32
    assert np.array_equal(first, second)
    assert not np.array_equal(first, DepthSensor().measure(*wall(2.0), np.random.default_rng(8)))
