"""The status says what the node does, in every state."""

from __future__ import annotations

import time

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from robot import camera_info_message, depth_message, rgb_message, wait_until
from stand_ins import wall_frame

from fus3dmaps_msgs.msg import MapperStatus

STAMP_NS = 1_700_000_000 * 10**9


def test_the_status_tells_what_came_what_was_lost_and_what_the_map_takes(make_robot) -> None:
    robot = make_robot(**{"node.status_period_s": 0.05, "map.memory_budget_mib": 64.0})
    robot.map(wall_frame(STAMP_NS))
    broken = rgb_message(wall_frame(STAMP_NS + 10**9))
    broken.encoding = "yuv422"
    robot.publishers["rgb"].publish(broken)
    wait_until(lambda: robot.mapper.drops.counts(), "a drop")
    now_s = time.monotonic()
    robot.mapper._monitor.diagnosis._clock = lambda: now_s  # Rates are those of the last seconds: let none pass.
    received = robot.listen(MapperStatus, "status")
    status = wait_until(lambda: next((each for each in received if each.drop_reasons), None), "status received")

    semantic_map = robot.mapper.pipeline.semantic_map
    assert status.state == "active"
    assert status.header.frame_id == "map"
    assert (status.encoder, status.segmenter) == ("stand_in", "lite")
    rates_hz = dict(zip(status.topics, status.rates_hz, strict=True))
    assert rates_hz.keys() == {"rgb/image", "depth/image", "rgb/camera_info", "pose"}
    assert all(rate_hz > 0 for rate_hz in rates_hz.values())
    assert (status.frames, status.dense_keyframes, status.instance_keyframes, status.not_keyframes) == (1, 1, 1, 0)
    assert dict(zip(status.drop_reasons, status.drop_counts, strict=True)) == dict(robot.mapper.drops.counts())
    assert (status.queue_depth, status.queue_size) == (0, 100)
    assert {"decode", "patch_encoder", "dense_update", "segmentation", "instance_update"} <= set(status.stages)
    assert all(0 < mean <= most for mean, most in zip(status.stage_mean_ms, status.stage_max_ms, strict=True))
    assert (status.voxels, status.dense_voxels) == (semantic_map.voxel_count, semantic_map.dense_voxel_count)
    assert status.instances == semantic_map.instance_count
    assert dict(zip(status.parts, status.part_bytes, strict=True)) == semantic_map.nbytes()
    assert status.memory_budget_bytes == 64 * 2**20
    # The stand-in camera's stamps are years old.
    assert any("clock" in problem for problem in status.problems)


def test_an_unconfigured_node_reports_too(make_robot) -> None:
    robot = make_robot(**{"node.autostart": False, "node.status_period_s": 0.05})
    received = robot.listen(MapperStatus, "status")
    wait_until(lambda: received, "status received")
    assert (received[0].state, received[0].voxels, list(received[0].stages)) == ("unconfigured", 0, [])


def test_topics_without_a_message_are_problems_while_active(robot) -> None:
    robot.publishers["info"].publish(camera_info_message(wall_frame(STAMP_NS)))
    diagnosis = robot.mapper._monitor.diagnosis
    wait_until(lambda: diagnosis.rates_hz()["rgb/camera_info"] > 0, "camera info came")
    diagnosis._clock = lambda: time.monotonic() + 6.0
    silent = [problem for problem in robot.mapper.status_message().problems if "no message on" in problem]
    assert len(silent) == 3
    assert any("rgb/image" in problem for problem in silent)
    robot.mapper.deactivate()
    assert robot.mapper.problems() == []


def test_diagnostics_are_published_while_active(make_robot) -> None:
    robot = make_robot(**{"node.status_period_s": 0.05})
    received: list[DiagnosticArray] = []
    robot.user.create_subscription(DiagnosticArray, "/diagnostics", received.append, 10)
    robot.map(wall_frame(STAMP_NS))
    own = robot.namespace.strip("/")

    def parts() -> dict[str, DiagnosticStatus]:
        newest = received[-1].status if received else []
        return {each.name.split(": ")[-1]: each for each in newest if each.name.startswith(own)}

    voxels = str(robot.mapper.pipeline.semantic_map.voxel_count)
    wait_until(
        lambda: (
            parts().keys() == {"inputs", "mapping", "map", "memory"}
            and voxels in [each.value.replace(",", "") for each in parts()["map"].values]
        ),
        "all parts reported",
    )
    robot.publishers["rgb"].publish(depth_message(wall_frame(STAMP_NS + 10**9)))
    wait_until(lambda: "unknown_encoding" in str(parts()), "the drop is named")
    robot.mapper.deactivate()
    wait_until(lambda: robot.user.count_publishers("/diagnostics") == 0, "no more reports")


def test_a_report_that_fails_does_not_end_the_reports(make_robot) -> None:
    robot = make_robot(**{"node.status_period_s": 0.05})
    failed: list[bool] = []

    def fail_once() -> list[str]:
        if not failed:
            failed.append(True)
            raise RuntimeError("the graph is gone")
        return []

    robot.mapper.problems = fail_once
    received = robot.listen(MapperStatus, "status")
    wait_until(lambda: failed, "a failure")
    count = len(received)
    wait_until(lambda: len(received) > count + 1, "reports go on")
