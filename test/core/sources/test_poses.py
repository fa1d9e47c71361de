"""Poses and extrinsics from each source: what images wait for, and the reasons when it does not come."""

from __future__ import annotations

import numpy as np
import pytest
import ros_messages as ros
from fed_pairer import FedPairer

from fus3dmaps_core.config.input import InputConfig
from fus3dmaps_core.errors import ConfigError
from fus3dmaps_core.sources.transforms import TransformTree

MS = 1_000_000
S = 1_000_000_000
START = 100 * S
HALF = float(np.sqrt(0.5))


class Setup:
    """A pairer with a camera model, and its transforms."""

    def __init__(self, **values) -> None:
        config = InputConfig(**values)
        self.tree = TransformTree(config.max_pose_gap_s)
        self.pairer = FedPairer(config, self.tree)
        self.pairer.add_camera_info(ros.camera_info())

    def moves(self, parent: str, child: str, stamp_ns: int, x_m: float) -> None:
        self.tree.add(ros.transforms((parent, child, stamp_ns, (x_m, 0.0, 0.0))), "/tf", static=False)

    def is_fixed(self, parent: str, child: str, *transform) -> None:
        self.tree.add(ros.transforms((parent, child, 0, *transform)), "/tf_static", static=True)

    def sees(self, stamp_ns: int) -> None:
        self.pairer.add_depth(ros.image(stamp_ns, "16UC1"))
        self.pairer.add_rgb(ros.image(stamp_ns))

    def poses(self) -> list[np.ndarray]:
        return [paired.T_world_camera for paired in self.pairer.poll()]


def test_poses_with_covariance():
    setup = Setup(pose_source="pose_with_covariance")
    setup.pairer.add_pose(ros.pose_with_covariance(START, (1.0, 2.0, 3.0)))
    setup.sees(START)
    np.testing.assert_array_equal(setup.poses()[0][:3, 3], [1, 2, 3])


def test_the_camera_is_looked_up_under_the_name_in_its_images():
    setup = Setup(pose_source="tf")
    setup.sees(START + 250 * MS)
    assert setup.poses() == []
    setup.moves("map", "base", START, 0.0)
    setup.moves("map", "base", START + 500 * MS, 2.0)
    assert setup.poses() == []
    setup.is_fixed("base", "camera", (0.0, 0.0, 1.0), (0.0, 0.0, HALF, HALF))
    expected = [[0, -1, 0, 1], [1, 0, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]]
    np.testing.assert_allclose(setup.poses()[0], expected, atol=1e-12)
    assert not setup.pairer.drops.counts()


def test_the_camera_may_be_named_and_the_body_mounted_by_parameter():
    setup = Setup(pose_source="tf", camera_frame="optical")
    setup.is_fixed("map", "optical", (3.0, 0.0, 0.0))
    setup.sees(START)
    assert setup.poses()[0][0, 3] == 3.0
    setup = Setup(pose_source="tf", body_frame="base", T_body_camera=[0.0, 4.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    setup.is_fixed("map", "base", (3.0, 0.0, 0.0))
    setup.sees(START)
    np.testing.assert_array_equal(setup.poses()[0][:3, 3], [3, 4, 0])


@pytest.mark.parametrize("body_frame", ["", "base"])
def test_odometry_of_a_body_and_the_mounting_from_tf(body_frame):
    setup = Setup(pose_source="odometry", extrinsic_source="tf", body_frame=body_frame)
    name = body_frame or "base_link"
    setup.moves(name, "camera", START, 1.0)  # A camera on a slide.
    setup.moves(name, "camera", START + 100 * MS, 2.0)
    for stamp_ns in (START, START + 100 * MS):
        setup.pairer.add_pose(ros.odometry(stamp_ns, (10.0, 0.0, 0.0)))
    setup.sees(START + 50 * MS)
    assert setup.poses()[0][0, 3] == 11.5


@pytest.mark.parametrize(
    ("reason", "named", "edges"),
    [
        ("tf_unknown_frame", "'camera'", []),
        ("tf_not_connected", "'camera'", [("sea", "camera", START, 0.0), ("map", "base", START, 0.0)]),
        ("no_pose", "'camera' to 'map'", [("map", "camera", START - 100 * MS, 0.0)]),
    ],
)
def test_what_does_not_come_is_given_up_by_name(reason, named, edges):
    setup = Setup(pose_source="tf", tf_timeout_s=0.5, max_wait_s=10.0)
    for edge in edges:
        setup.moves(*edge)
    setup.sees(START)
    setup.sees(START + 500 * MS)
    assert setup.poses() == []
    assert not setup.pairer.drops.counts()
    setup.sees(START + 501 * MS)
    assert setup.poses() == []
    assert setup.pairer.drops.counts() == {reason: 1}
    assert "rgb/image" in setup.pairer.drops.latest()[reason]
    assert named in setup.pairer.drops.latest()[reason]


@pytest.mark.parametrize(
    ("reason", "offsets_ms"), [("no_pose", (1, 100)), ("pose_gap", (-400, 400))], ids=["before the first", "gap"]
)
def test_what_cannot_come_is_given_up_at_once(reason, offsets_ms):
    setup = Setup(pose_source="tf")
    for offset_ms in offsets_ms:
        setup.moves("map", "camera", START + offset_ms * MS, 0.0)
    setup.sees(START)
    assert setup.poses() == []
    assert setup.pairer.drops.counts() == {reason: 1}


def test_an_image_without_a_frame_says_what_to_set():
    setup = Setup(pose_source="tf")
    nameless = ros.image(START)
    nameless.header.frame_id = ""
    setup.pairer.add_depth(ros.image(START, "16UC1"))
    setup.pairer.add_rgb(nameless)
    assert setup.poses() == []
    assert "input.camera_frame" in setup.pairer.drops.latest()["tf_unknown_frame"]


def test_a_restart_forgets_what_moved():
    setup = Setup(pose_source="tf")
    setup.moves("map", "camera", START, 1.0)
    setup.sees(START)
    assert len(setup.poses()) == 1
    setup.sees(START - 50 * S)
    setup.moves("map", "camera", START - 50 * S, 2.0)
    assert setup.poses()[0][0, 3] == 2.0


def test_without_tf_its_use_is_refused():
    with pytest.raises(ConfigError, match=r"input\.pose_source"):
        FedPairer(InputConfig(pose_source="tf"))
    with pytest.raises(ConfigError, match=r"input\.extrinsic_source"):
        FedPairer(InputConfig(pose_source="odometry", extrinsic_source="tf"))


@pytest.mark.parametrize("name", ["T_body_camera", "T_rgb_depth"])
def test_an_extrinsic_that_is_no_pose_is_refused(name):
    with pytest.raises(ConfigError, match=rf"input\.{name}"):
        FedPairer(InputConfig(**{name: [0.0] * 7}))
