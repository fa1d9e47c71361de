"""The ``fus3dmaps`` command. ROS is imported only by the commands that need it: node, play, ask and demo."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from fus3dmaps_core.errors import ConfigError, Fus3dmapsError, RecordingError
from fus3dmaps_lab.datasets.registry import names as dataset_names
from fus3dmaps_ros.commands.settings import DatasetOptions, ParamsFile, Settings, configuration, directory, pairs

if TYPE_CHECKING:
    from fus3dmaps_core.answers.query import RankedInstance
    from fus3dmaps_core.frame import PosedFrame

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    help="Open-vocabulary 3D maps from posed RGB-D images.",
)
_log = Console(stderr=True, highlight=False)
_out = Console(highlight=False)

Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")]


def main() -> None:
    """Run the command; a refusal is one line on stderr and exit code 1."""
    try:
        app()
    except Fus3dmapsError as error:
        _log.print(f"fus3dmaps: {error}", markup=False, style="red", soft_wrap=True)
        sys.exit(1)
    except KeyboardInterrupt:
        sys.exit(130)


@app.command()
def convert(
    dataset: Annotated[str, typer.Argument(help=f"Layout of the folder: {', '.join(dataset_names())}.")],
    directory: Annotated[Path, typer.Argument(help="The dataset's folder.")],
    out: Annotated[Path, typer.Argument(help="Recording to write, ending in .mcap.")],
    overwrite: Overwrite = False,
    options: DatasetOptions = None,
) -> None:
    """Turn a dataset into a rosbag2 MCAP recording."""
    from fus3dmaps_lab.datasets.convert import convert as convert_dataset

    with _progress("writing frames") as update:
        summary = convert_dataset(
            dataset, directory, out, overwrite=overwrite, on_progress=update, options=pairs("--option", options)
        )
    _out.print(
        f"{out}: {summary.frames} frames, {summary.duration_s:.1f} s of recording, {summary.size_bytes / 1e6:.0f} MB",
        markup=False,
        soft_wrap=True,
    )


@app.command(name="map")
def map_(
    bag: Annotated[Path, typer.Argument(help="rosbag2 directory or MCAP file.")],
    out: Annotated[Path, typer.Option("--out", parser=directory, metavar="DIRECTORY", help="Directory for the map.")],
    params_file: ParamsFile = None,
    settings: Settings = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the run's figures to this file.")] = None,
) -> None:
    """Map a recording in process and save the map."""
    from fus3dmaps_core.offline import map_info, map_recording
    from fus3dmaps_core.pipeline import Pipeline
    from fus3dmaps_core.saved_maps.storage import check_map_target, save_map

    config = configuration(params_file, settings)
    check_map_target(out)
    with _log.status("loading models"):
        pipeline = Pipeline.from_config(config)
    try:
        with _progress("mapping frames") as update:
            summary = map_recording(bag, pipeline, update)
    except RecordingError:
        if pipeline.semantic_map.voxel_count:
            pipeline.semantic_map.fuse()
            save_map(out, pipeline.semantic_map, map_info(pipeline))
            _log.print(f"what could be read is mapped and saved in '{out}'", markup=False, style="yellow", soft_wrap=True)
        raise
    save_map(out, pipeline.semantic_map, map_info(pipeline))

    semantic_map = pipeline.semantic_map
    table = Table("stage", "s", "share", title=f"{out}", title_justify="left")
    ledger, counts = summary.ledger, summary.ledger.counts()
    for stage, seconds in sorted(ledger.stages_s().items(), key=lambda item: -item[1]):
        table.add_row(stage, f"{seconds:.2f}", f"{100 * seconds / summary.duration_s:.1f} %")
    _out.print(table)
    _out.print(
        f"{counts.frames} frames, {counts.dense_keyframes} dense and {counts.instance_keyframes} instance keyframes in "
        f"{summary.duration_s:.1f} s ({summary.keyframes_per_s:.2f} keyframes/s); {semantic_map.voxel_count} voxels, "
        f"{semantic_map.instance_count} instances, {sum(semantic_map.nbytes().values()) / 1e6:.0f} MB"
    )
    latest = ledger.drops.latest()
    for reason, count in ledger.drops.counts().most_common():
        _log.print(f"dropped {count}, {reason}: {latest[reason]}", markup=False, style="yellow")
    if json_file is not None:
        figures = {
            "frames": counts.frames,
            "dense_keyframes": counts.dense_keyframes,
            "instance_keyframes": counts.instance_keyframes,
            "proposals": counts.proposals,
            "duration_s": summary.duration_s,
            "keyframes_per_s": summary.keyframes_per_s,
            "stages_s": ledger.stages_s(),
            "drops": dict(ledger.drops.counts()),
            "voxels": semantic_map.voxel_count,
            "dense_voxels": semantic_map.dense_voxel_count,
            "instances": semantic_map.instance_count,
            "bytes": semantic_map.nbytes(),
        }
        json_file.write_text(json.dumps(figures, indent=1))


@app.command()
def query(
    map_directory: Annotated[Path, typer.Argument(metavar="MAPDIR", help="A saved map.")],
    prompts: Annotated[list[str], typer.Argument(metavar="PROMPT...", help="What to look for, in plain words.")],
    top: Annotated[int | None, typer.Option("--top", min=1, help="Answers per prompt.")] = None,
    layer: Annotated[str, typer.Option("--layer", help="dense, fused_dense, instances or fused_instances.")] = "",
    negative: Annotated[list[str] | None, typer.Option("--not", help="What it is not; repeatable.")] = None,
    threshold: Annotated[float | None, typer.Option("--threshold", help="Leave out what scores less.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list, best first.")] = False,
    png: Annotated[Path | None, typer.Option("--png", help="Draw the answer into this picture.")] = None,
    ply: Annotated[Path | None, typer.Option("--ply", help="Write voxel similarities to this PLY file.")] = None,
    weights: Annotated[
        str | None, typer.Option("--weights", help="Where the encoder's weights are, instead of where the map's were.")
    ] = None,
) -> None:
    """Ask a saved map where something is."""
    from fus3dmaps_core.answers.query import DEFAULT_LAYER, TextQuery, answer_query
    from fus3dmaps_core.encoders.registry import load_text_encoder
    from fus3dmaps_core.saved_maps.storage import load_map

    request = TextQuery(prompts, tuple(negative or ()), layer or DEFAULT_LAYER, threshold)
    request.check()
    semantic_map, info = load_map(map_directory)
    request = TextQuery(
        prompts,
        tuple(negative or ()),
        request.layer,
        threshold,
        top or info.config.query.top_k,
        info.config.query.min_voxels,
    )
    text_encoder = load_text_encoder(info.encoder, "cpu", info.config.encoder.weights if weights is None else weights)
    answer = answer_query(semantic_map, text_encoder, request, info.logit_scale)
    _print_answer(answer.instances, prompts, info.map_frame, as_json)
    if png is not None:
        from fus3dmaps_core.answers.render import render_answer, write_png

        voxels = semantic_map.voxels()
        picture = render_answer(
            voxels.centers_m,
            voxels.colors,
            answer.points_m,
            answer.similarity,
            answer.instances,
            info.camera_poses,
            info.config.map.voxel_size_m,
            f"{' | '.join(prompts)}   ({answer.layer})",
        )
        write_png(png, picture)
    if ply is not None:
        from fus3dmaps_core.answers.render import write_ply

        write_ply(ply, answer.points_m, answer.similarity)


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def node(context: typer.Context) -> None:
    """Run the mapper node; arguments go to ROS, e.g. --ros-args -p map.voxel_size_m:=0.1 -r rgb/image:=/camera/image."""
    _need_ros()
    from fus3dmaps_ros.mapper_node import main as run_node

    sys.exit(run_node(context.args))


@app.command()
def play(
    bag: Annotated[Path, typer.Argument(help="rosbag2 directory or MCAP file.")],
    rate: Annotated[float, typer.Option("--rate", min=0.0, help="Speed; 0 plays as fast as it is taken.")] = 1.0,
    wait: Annotated[float, typer.Option("--wait", min=0.0, help="Longest wait for subscribers, seconds.")] = 60.0,
) -> None:
    """Publish a recording on its topics, with /clock."""
    _need_ros()
    from fus3dmaps_ros.player_node import play as run_player

    sys.exit(run_player(bag, rate=rate, wait_for_subscribers_s=wait))


@app.command()
def ask(
    prompts: Annotated[list[str], typer.Argument(metavar="PROMPT...", help="What to look for, in plain words.")],
    top: Annotated[int, typer.Option("--top", min=1, help="Answers per prompt.")] = 5,
    layer: Annotated[str, typer.Option("--layer", help="dense, fused_dense, instances or fused_instances.")] = "",
    negative: Annotated[list[str] | None, typer.Option("--not", help="What it is not; repeatable.")] = None,
    node_name: Annotated[str, typer.Option("--node", help="The mapper node.")] = "/fus3dmaps",
    timeout: Annotated[float, typer.Option("--timeout", min=0.1, help="Longest wait for the node, seconds.")] = 10.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list, best first.")] = False,
) -> None:
    """Ask a running mapper node where something is, and have it publish the similarities."""
    _need_ros()
    from fus3dmaps_ros.commands.client import MapperClient, ranked_instances

    with MapperClient(node_name) as client:
        client.wait_until_ready(timeout)
        reply = client.ask(prompts, negative_prompts=negative or (), layer=layer, top_k=top, publish=True, timeout_s=timeout)
    _print_answer(ranked_instances(reply), prompts, reply.similarity.header.frame_id, as_json)


@app.command()
def simulate(
    out: Annotated[Path, typer.Argument(help="Recording to write, ending in .mcap.")],
    frames: Annotated[int | None, typer.Option("--frames", min=2, help="Frames along the way.")] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Decides textures, furniture and depth noise.")] = 0,
    rooms: Annotated[int, typer.Option("--rooms", min=0, help="A building with so many rooms a storey instead.")] = 0,
    storeys: Annotated[int, typer.Option("--storeys", min=1, help="Storeys of the building.")] = 1,
    overwrite: Overwrite = False,
) -> None:
    """Record a simulated furnished room in which real photographs hang, or a plain building of many rooms."""
    from fus3dmaps_core.recordings.writer import RecordingWriter
    from fus3dmaps_lab.simulation.building.simulated_building import SimulatedBuilding
    from fus3dmaps_lab.simulation.room.furnished_room import FurnishedRoom

    source: Iterator[PosedFrame]
    if rooms:
        building = SimulatedBuilding(seed=seed, storeys=storeys, rooms_per_storey=rooms, frames=frames)
        count, source = len(building), (labelled.frame for labelled in building)
    else:
        room = FurnishedRoom(seed=seed, frames=frames or 60)
        count, source = len(room), iter(room)
    with _progress("rendering frames") as update, RecordingWriter(out, overwrite=overwrite) as writer:
        for done, frame in enumerate(source, start=1):
            writer.write(frame)
            update(done, count)
    _out.print(f"{out}: {count} frames", markup=False, soft_wrap=True)


@app.command()
def evaluate(
    target: Annotated[str, typer.Argument(help="simulation, or a dataset's layout as for convert.")] = "simulation",
    directory: Annotated[Path | None, typer.Argument(help="The dataset's folder.")] = None,
    seeds: Annotated[int, typer.Option("--seeds", min=1, help="How many buildings are simulated.")] = 5,
    quick: Annotated[bool, typer.Option("--quick", help="Smaller buildings, no sweeps.")] = False,
    jobs: Annotated[int, typer.Option("--jobs", min=0, help="Buildings at once; 0: one for each processor.")] = 0,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write a JSON list of records to this file.")] = None,
    report: Annotated[Path | None, typer.Option("--report", help="Write tables and plots into this directory.")] = None,
    options: DatasetOptions = None,
    params_file: ParamsFile = None,
    settings: Settings = None,
) -> None:
    """Measure how good maps are: on simulated buildings, or on a labelled dataset."""
    from fus3dmaps_ros.commands.evaluate_command import Destination, Evaluation, evaluate_target

    request = Evaluation(target, directory, seeds, quick, jobs, pairs("--option", options))
    evaluate_target(request, configuration(params_file, settings), Destination(json_file, report, _out), _progress)


@app.command()
def encoders(
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON list.")] = False,
    weights: Annotated[str | None, typer.Option("--weights", help="Where weights are; the same as encoder.weights.")] = None,
    params_file: ParamsFile = None,
    settings: Settings = None,
) -> None:
    """List the encoders: their space, their licences, and what of them is installed."""
    from fus3dmaps_ros.commands.encoders_command import list_encoders

    config = configuration(params_file, settings)
    if weights is not None:
        config = config.with_values({"encoder.weights": weights})
    list_encoders(config, _out, as_json=as_json)


@app.command()
def export(
    out: Annotated[
        Path,
        typer.Option(
            "--out",
            parser=directory,
            metavar="DIRECTORY",
            help="Directory for graphs and engines; later encoder.graph_directory.",
        ),
    ],
    encoder: Annotated[str | None, typer.Option("--encoder", help="Which encoders; the same as encoder.name.")] = None,
    precision: Annotated[str | None, typer.Option("--precision", help="fp32, fp16 or bf16; as encoder.precision.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print a JSON object.")] = False,
    params_file: ParamsFile = None,
    settings: Settings = None,
) -> None:
    """Write the networks of encoders as checked ONNX files, and build TensorRT engines where TensorRT is installed."""
    from fus3dmaps_ros.commands.export_command import export_encoders

    chosen = {"encoder.name": encoder, "encoder.precision": precision}
    config = configuration(params_file, settings).with_values(
        {key: value for key, value in chosen.items() if value is not None}
    )
    export_encoders(config, out, _out, as_json=as_json)


@app.command()
def demo(
    recording: Annotated[Path | None, typer.Argument(help="Recording to use instead of the simulated room.")] = None,
    prompts: Annotated[list[str] | None, typer.Argument(metavar="PROMPT...", help="What to ask.")] = None,
    out: Annotated[
        Path, typer.Option("--out", parser=directory, metavar="DIRECTORY", help="Directory for pictures and logs.")
    ] = Path("out/demo"),
) -> None:
    """Play a recording into a mapper node, ask it for things and draw the answers."""
    _need_ros()
    from fus3dmaps_ros.commands.demo import run_demo

    if not run_demo(recording, prompts or (), out, _out):
        sys.exit(1)


def _print_answer(instances: Sequence[RankedInstance], prompts: Sequence[str], frame: str, as_json: bool) -> None:
    if as_json:
        print(json.dumps([_as_json(found, len(prompts) > 1) for found in instances]))
        return
    for prompt in prompts:
        table = Table(title=f"{escape(prompt)}   (metres, frame {escape(frame)})", title_justify="left")
        for heading in ("rank", "score", "position", "size", "voxels", "id"):
            table.add_column(heading, no_wrap=True)
        for rank, found in enumerate((found for found in instances if found.prompt == prompt), start=1):
            place = "  ".join(f"{value:.2f}" for value in found.centroid_m)
            size = " x ".join(f"{edge:.2f}" for edge in found.box_max_m - found.box_min_m)
            table.add_row(str(rank), f"{found.score:.3f}", place, size, str(found.voxels), str(found.id))
        _out.print(table)


def _as_json(found: RankedInstance, with_prompt: bool) -> dict[str, Any]:
    entry = {
        "id": found.id,
        "score": found.score,
        "centroid": [float(value) for value in found.centroid_m],
        "box_min": [float(value) for value in found.box_min_m],
        "box_max": [float(value) for value in found.box_max_m],
        "voxels": found.voxels,
    }
    return {**entry, "prompt": found.prompt} if with_prompt else entry


def _need_ros() -> None:
    try:
        import rclpy  # noqa: F401
    except ImportError as error:
        raise ConfigError(
            f"this command needs ROS 2: {error}; source a Jazzy installation or run scripts/setup.sh"
        ) from None


@contextmanager
def _progress(label: str) -> Iterator[Callable[[int, int], None]]:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
    )
    progress = Progress(*columns, console=_log)
    task = progress.add_task(label, total=None)

    def update(done: int, total: int) -> None:
        progress.start()  # Not before there is something to show: a refusal is to stand alone.
        progress.update(task, completed=done, total=total)

    try:
        yield update
    finally:
        progress.stop()


if __name__ == "__main__":
    main()
