"""A long drive: memory, threads and handles stay where they are while it maps, answers five times a second and saves.

It takes some seconds here; FUS3DMAPS_SOAK_S=1800 makes it the half hour that a release is put through.
"""

from __future__ import annotations

import ctypes
import gc
import math
import os
import threading
import time
from pathlib import Path

from robot import TIMEOUT_S, Robot, wait_until
from stand_ins import wall_frame

from fus3dmaps_core.saved_maps.directory import map_path
from fus3dmaps_core.saved_maps.storage import load_map
from fus3dmaps_msgs.srv import QueryText, SaveMap

SECOND_NS = 10**9
START_NS = 1_700_000_000 * SECOND_NS
DURATION_S = float(os.environ.get("FUS3DMAPS_SOAK_S", "12"))
QUERY_PERIOD_S = 0.2
SAVE_PERIOD_S = min(60.0, DURATION_S / 6)
LAP = 40
KEPT_FRAMES = 150  # More than the publishers keep for late subscribers.
# Queues, middleware and allocator settle within minutes and differ by tens of megabytes from run to run; a frame has two, so
# that a few per cent of the frames that stayed would be seen even in a short drive.
MAY_GROW_BYTES = 64 * 2**20


def resident_bytes() -> int:
    """Memory that is in use, without what the allocator keeps for later."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def handles() -> int:
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208


def drive(robot: Robot, duration_s: float, number: int) -> int:
    """Frames along a wall and back, with questions and saves; returns the number of the next frame."""
    client = robot.user.create_client(QueryText, "fus3dmaps/query_text")
    assert client.wait_for_service(TIMEOUT_S)
    started = asked = saved = time.monotonic()
    answers = []
    while time.monotonic() - started < duration_s or number < KEPT_FRAMES:
        phase = 2 * math.pi * number / LAP
        robot.show(wall_frame(START_NS + number * SECOND_NS // 10, x_m=math.sin(phase)))
        number += 1
        now = time.monotonic()
        if now - asked > QUERY_PERIOD_S:
            asked = now
            answers = [each for each in answers if not each.done() or not each.result().success]
            answers.append(client.call_async(QueryText.Request(prompts=["red"], publish=True)))
        if now - saved > SAVE_PERIOD_S:
            saved = now
            assert robot.call(SaveMap, "save_map", name="soak").success
        time.sleep(0.02)
    wait_until(lambda: all(each.done() for each in answers), "every question is answered")
    assert all(each.result().success for each in answers)
    robot.user.destroy_client(client)
    wait_until(lambda: not robot.mapper.worker.waiting, "every frame is mapped")
    return number


def test_nothing_grows(make_robot, tmp_path) -> None:
    robot = make_robot(
        **{"node.map_directory": str(tmp_path), "node.autosave_period_s": 2.0 * SAVE_PERIOD_S, "node.queue_size": 4}
    )
    robot.map(wall_frame(START_NS))
    number = drive(robot, DURATION_S / 3, 1)  # The wall is mapped then, and everything that is made once is made.
    voxels, threads, open_files, memory = (
        robot.mapper.pipeline.semantic_map.voxel_count,
        threading.active_count(),
        handles(),
        resident_bytes(),
    )
    drive(robot, DURATION_S, number)
    semantic_map = robot.mapper.pipeline.semantic_map
    print(
        f"soak of {DURATION_S:.0f} s: {robot.mapper.status()}; memory {(resident_bytes() - memory) / 2**20:+.1f} MiB,"
        f" threads {threading.active_count() - threads:+d}, handles {handles() - open_files:+d},"
        f" voxels {semantic_map.voxel_count - voxels:+d}"
    )
    assert robot.mapper.worker.ledger.counts().dense_keyframes > 10
    assert threading.active_count() <= threads + 1
    assert handles() <= open_files + 2
    assert resident_bytes() - memory < MAY_GROW_BYTES
    assert load_map(map_path(tmp_path, "soak"))[0].voxel_count > 0
