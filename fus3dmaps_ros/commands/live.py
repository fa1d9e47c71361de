"""``fus3dmaps node``, ``play``, ``ask`` and ``demo``: the commands that need ROS, which is imported when they run."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from fus3dmaps_ros.commands.settings import AnswerAsJson, Layer, Negative, Prompts, directory
from fus3dmaps_ros.commands.terminal import OUT, need_ros, print_answer


def node(context: typer.Context) -> None:
    """Run the mapper node; arguments go to ROS, e.g. --ros-args -p map.voxel_size_m:=0.1 -r rgb/image:=/camera/image."""
    need_ros()
    from fus3dmaps_ros.mapper_node import main as run_node

    sys.exit(run_node(context.args))


def play(
    bag: Annotated[Path, typer.Argument(help="rosbag2 directory or MCAP file.")],
    rate: Annotated[float, typer.Option("--rate", min=0.0, help="Speed; 0 plays as fast as it is taken.")] = 1.0,
    wait: Annotated[float, typer.Option("--wait", min=0.0, help="Longest wait for subscribers, seconds.")] = 60.0,
) -> None:
    """Publish a recording on its topics, with /clock."""
    need_ros()
    from fus3dmaps_ros.player_node import play as run_player

    sys.exit(run_player(bag, rate=rate, wait_for_subscribers_s=wait))


def ask(
    prompts: Prompts,
    top: Annotated[int, typer.Option("--top", min=1, help="Answers per prompt.")] = 5,
    layer: Layer = "",
    negative: Negative = None,
    node_name: Annotated[str, typer.Option("--node", help="The mapper node.")] = "/fus3dmaps",
    timeout: Annotated[float, typer.Option("--timeout", min=0.1, help="Longest wait for the node, seconds.")] = 10.0,
    as_json: AnswerAsJson = False,
) -> None:
    """Ask a running mapper node where something is, and have it publish the similarities."""
    need_ros()
    from fus3dmaps_ros.commands.client import MapperClient, ranked_instances

    with MapperClient(node_name) as client:
        client.wait_until_ready(timeout)
        reply = client.ask(prompts, negative_prompts=negative or (), layer=layer, top_k=top, publish=True, timeout_s=timeout)
    print_answer(ranked_instances(reply), prompts, reply.similarity.header.frame_id, as_json)


def demo(
    recording: Annotated[Path | None, typer.Argument(help="Recording to use instead of the simulated room.")] = None,
    prompts: Annotated[list[str] | None, typer.Argument(metavar="PROMPT...", help="What to ask.")] = None,
    out: Annotated[
        Path, typer.Option("--out", parser=directory, metavar="DIRECTORY", help="Directory for pictures and logs.")
    ] = Path("out/demo"),
) -> None:
    """Play a recording into a mapper node, ask it for things and draw the answers."""
    need_ros()
    from fus3dmaps_ros.commands.demo import run_demo

    if not run_demo(recording, prompts or (), out, OUT):
        sys.exit(1)
