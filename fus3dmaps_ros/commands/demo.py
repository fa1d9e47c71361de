"""``fus3dmaps demo``: a recording is played through DDS into a mapper node, which is then asked for things in words.

Node and player are two processes, as on a robot. Without a recording the furnished room is recorded first; its ground truth
then tells whether each answer is right.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from rich.console import Console

from fus3dmaps_core.answers.query import RankedInstance
from fus3dmaps_core.answers.render import render_answer, write_png
from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.errors import Fus3dmapsError, QueryError, RecordingError
from fus3dmaps_core.messages.fields import stamp_ns
from fus3dmaps_core.recordings.reader import RecordingReader
from fus3dmaps_core.recordings.writer import RecordingWriter
from fus3dmaps_lab.simulation.room.furnished_room import FurnishedRoom
from fus3dmaps_ros.commands.client import MapperClient, ranked_instances, similarity_points

ROOM_PROMPTS = {
    "a pet that meows": "cat",
    "a drink that wakes you up": "coffee",
    "a two-wheeled vehicle with an engine": "motorcycle",
}
"""Prompts for the room and the object that each means. None of the prompts is a class name of the networks."""

RECORDING_PROMPTS = ("something to drink from", "a place to sit", "a display that shows pictures")
"""Prompts for the user's recording if the user gives none."""

NODE_PARAMETERS: dict[str, str] = {}
"""Parameters of the node besides those that the demonstration itself needs."""

_MODELS_TIMEOUT_S = 180.0
_PATIENCE_S = 20.0  # If no newer frame is in the map this long after the last was played, the node has finished.


def run_demo(recording: Path | None, prompts: Sequence[str], out: Path, console: Console) -> bool:
    """Run the demonstration; pictures and logs go to ``out``.

    Args:
        recording: rosbag2 directory or MCAP file; None records the furnished room.
        prompts: What to ask; empty takes the defaults.
        out: Directory, made if missing.
        console: Shows what happens.

    Returns:
        Whether every answer was right, as far as that is known.

    Raises:
        Fus3dmapsError: The recording cannot be read, a process ended before its time, or the node does not answer.
    """
    out.mkdir(parents=True, exist_ok=True)
    room = FurnishedRoom() if recording is None else None
    if room is not None:
        recording = out / "room.mcap"
        _record(room, recording, console)
        asked = tuple(prompts) or tuple(ROOM_PROMPTS)
    else:
        asked = tuple(prompts) or RECORDING_PROMPTS
    assert recording is not None
    config = Config()
    with RecordingReader(recording) as reader:
        images = reader.topics[_topic(reader, config.input.rgb_topic)].count
        end_ns = reader.end_ns

    environment = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", "PYTHONUNBUFFERED": "1"}
    environment.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    os.environ.update(environment)
    # The queue holds the whole recording, so that a slow machine maps the same frames as a quick one.
    parameters = {"node.queue_size": str(max(images, 1)), **NODE_PARAMETERS}
    settings = [word for key, value in parameters.items() for word in ("-p", f"{key}:={value}")]
    node = [sys.executable, "-m", "fus3dmaps_ros.commands.cli", "node", "--ros-args", *settings]
    player = [sys.executable, "-m", "fus3dmaps_ros.commands.cli", "play", str(recording)]
    with _process("node", node, out / "node.log", environment) as mapper, MapperClient() as client:
        console.print("node: loading models")
        _wait_until_ready(client, mapper, out / "node.log")
        console.print(f"player: {images} images from {recording}", markup=False, soft_wrap=True)
        with _process("player", player, out / "player.log", environment) as playing:
            _follow(client, mapper, playing, asked[0], end_ns, out, console)
        return _ask(client, asked, room, config, out, console)


def _record(room: FurnishedRoom, path: Path, console: Console) -> None:
    started = time.perf_counter()
    with RecordingWriter(path, overwrite=True) as writer:
        for frame in room:
            writer.write(frame)
    console.print(
        f"recorded a furnished room: {len(room)} frames in {time.perf_counter() - started:.0f} s, {path}",
        markup=False,
        soft_wrap=True,
    )


def _topic(reader: RecordingReader, name: str) -> str:
    for topic in reader.topics:
        if topic.strip("/") == name.strip("/"):
            return topic
    raise RecordingError(f"the recording has no topic '{name}'; it has {', '.join(sorted(reader.topics))}")


@contextmanager
def _process(name: str, command: Sequence[str], log: Path, environment: dict[str, str]) -> Iterator[subprocess.Popen[bytes]]:
    """Start a child process that logs to a file; when the block is left, interrupt it as Ctrl-C does."""
    with log.open("wb") as file:
        process = subprocess.Popen(command, stdout=file, stderr=subprocess.STDOUT, env=environment, start_new_session=True)
    try:
        yield process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGINT)
            try:
                process.wait(timeout=15)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                raise Fus3dmapsError(f"the {name} did not stop; see '{log}'") from None


def _check_alive(process: subprocess.Popen[bytes], name: str, log: Path) -> None:
    if process.poll() not in (None, 0):
        tail = "\n".join(log.read_text(errors="replace").splitlines()[-8:])
        raise Fus3dmapsError(f"the {name} ended with exit code {process.returncode}; the end of '{log}':\n{tail}")


def _wait_until_ready(client: MapperClient, mapper: subprocess.Popen[bytes], log: Path) -> None:
    deadline = time.monotonic() + _MODELS_TIMEOUT_S
    while True:
        _check_alive(mapper, "node", log)
        try:
            client.wait_until_ready(1.0)
            return
        except QueryError:
            if time.monotonic() > deadline:
                raise


def _follow(
    client: MapperClient,
    mapper: subprocess.Popen[bytes],
    playing: subprocess.Popen[bytes],
    prompt: str,
    end_ns: int,
    out: Path,
    console: Console,
) -> None:
    """Ask while the node maps, until the map has the recording's last frame or grows no more."""
    newest_ns, changed, last = 0, time.monotonic(), ""
    while newest_ns < end_ns:
        _check_alive(mapper, "node", out / "node.log")
        _check_alive(playing, "player", out / "player.log")
        time.sleep(3.0)
        try:
            reply = client.ask([prompt], top_k=1)
        except QueryError as error:
            if str(error) != last:
                console.print(f"  while mapping: {error}", markup=False, soft_wrap=True)
            last = str(error)
            newer = newest_ns
        else:
            newer = stamp_ns(reply.similarity)
            best = ranked_instances(reply)
            where = _place(best[0]) if best else "no instance yet"
            if where != last:
                console.print(f"  while mapping: '{prompt}' {where}", markup=False, soft_wrap=True)
            last = where
        if newer != newest_ns:
            newest_ns, changed = newer, time.monotonic()
        elif playing.poll() is not None and time.monotonic() - changed > _PATIENCE_S:
            break


def _ask(
    client: MapperClient, prompts: Sequence[str], room: FurnishedRoom | None, config: Config, out: Path, console: Console
) -> bool:
    all_right = True
    newest_ns = stamp_ns(client.ask(prompts[:1], top_k=1).similarity)
    points_m, colors = client.map_cloud(newest_ns)
    camera_poses = client.camera_poses(newest_ns)
    for prompt in prompts:
        reply = client.ask([prompt], top_k=3, publish=True)
        found = ranked_instances(reply)
        console.print(f'\n"{prompt}"', markup=False, style="bold")
        for rank, instance in enumerate(found, start=1):
            console.print(
                f"  {rank}. score {instance.score:.3f} {_place(instance)}, {instance.voxels} voxels",
                markup=False,
                soft_wrap=True,
            )
        expected = ROOM_PROMPTS.get(prompt) if room is not None else None
        if room is not None and expected is not None:
            right = bool(found) and _is_object(found[0], room, expected)
            all_right &= right
            console.print(f"  {'right' if right else 'WRONG'}: the {expected}", style="green" if right else "red")
        path = out / f"{re.sub('[^a-z0-9]+', '_', prompt.lower()).strip('_')}.png"
        voxel_points_m, similarity = similarity_points(reply)
        picture = render_answer(
            points_m, colors, voxel_points_m, similarity, found, camera_poses, config.map.voxel_size_m, f'"{prompt}"'
        )
        write_png(path, picture)
        console.print(f"  {path}", markup=False, soft_wrap=True)
    return all_right


def _place(instance: RankedInstance) -> str:
    x, y, z = instance.centroid_m
    return f"at x {x:.2f}, y {y:.2f}, z {z:.2f} m"


def _is_object(instance: RankedInstance, room: FurnishedRoom, name: str) -> bool:
    """Return whether the answer's centroid lies in the object, with a margin for the voxels that noise adds around it."""
    (target,) = (candidate for candidate in room.objects if candidate.name == name)
    margin_m = 0.1
    centroid = np.asarray(instance.centroid_m, np.float64)
    return bool(np.all(centroid >= target.box_min_m - margin_m) and np.all(centroid <= target.box_max_m + margin_m))
