"""``fus3dmaps map`` and ``fus3dmaps query``: from a recording to a saved map, and from a saved map to answers. No ROS."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from fus3dmaps_core.errors import RecordingError
from fus3dmaps_ros.commands.settings import (
    AnswerAsJson,
    Layer,
    Negative,
    ParamsFile,
    Prompts,
    Settings,
    configuration,
    directory,
)
from fus3dmaps_ros.commands.terminal import LOG, OUT, print_answer, progress

if TYPE_CHECKING:
    from fus3dmaps_core.offline import RunSummary
    from fus3dmaps_core.voxel_map.semantic_map import SemanticMap


def map_(
    bag: Annotated[Path, typer.Argument(help="rosbag2 directory or MCAP file.")],
    out: Annotated[Path, typer.Option("--out", parser=directory, metavar="DIRECTORY", help="Directory for the map.")],
    params_file: ParamsFile = None,
    settings: Settings = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the run's figures to this file.")] = None,
) -> None:
    """Map a recording in process and save the map."""
    from fus3dmaps_core.offline import map_recording
    from fus3dmaps_core.pipeline import Pipeline
    from fus3dmaps_core.saved_maps.storage import check_map_target, save_map

    config = configuration(params_file, settings)
    check_map_target(out)
    with LOG.status("loading models"):
        pipeline = Pipeline.from_config(config)
    try:
        with progress("mapping frames") as update:
            summary = map_recording(bag, pipeline, update)
    except RecordingError:
        if pipeline.semantic_map.voxel_count:
            pipeline.semantic_map.fuse()
            save_map(out, pipeline)
            LOG.print(f"what could be read is mapped and saved in '{out}'", markup=False, style="yellow", soft_wrap=True)
        raise
    save_map(out, pipeline)
    _print_summary(summary, pipeline.semantic_map, str(out))
    if json_file is not None:
        json_file.write_text(json.dumps(_figures(summary, pipeline.semantic_map), indent=1))


def _print_summary(summary: RunSummary, semantic_map: SemanticMap, title: str) -> None:
    ledger, counts = summary.ledger, summary.ledger.counts()
    table = Table("stage", "s", "share", title=title, title_justify="left")
    for stage, seconds in sorted(ledger.stages_s().items(), key=lambda item: -item[1]):
        table.add_row(stage, f"{seconds:.2f}", f"{100 * seconds / summary.duration_s:.1f} %")
    OUT.print(table)
    OUT.print(
        f"{counts.frames} frames, {counts.dense_keyframes} dense and {counts.instance_keyframes} instance keyframes in "
        f"{summary.duration_s:.1f} s ({summary.keyframes_per_s:.2f} keyframes/s); {semantic_map.voxel_count} voxels, "
        f"{semantic_map.instance_count} instances, {sum(semantic_map.nbytes().values()) / 1e6:.0f} MB"
    )
    latest = ledger.drops.latest()
    for reason, count in ledger.drops.counts().most_common():
        LOG.print(f"dropped {count}, {reason}: {latest[reason]}", markup=False, style="yellow")


def _figures(summary: RunSummary, semantic_map: SemanticMap) -> dict[str, Any]:
    counts = summary.ledger.counts()
    return {
        "frames": counts.frames,
        "dense_keyframes": counts.dense_keyframes,
        "instance_keyframes": counts.instance_keyframes,
        "proposals": counts.proposals,
        "duration_s": summary.duration_s,
        "keyframes_per_s": summary.keyframes_per_s,
        "stages_s": summary.ledger.stages_s(),
        "drops": dict(summary.ledger.drops.counts()),
        "voxels": semantic_map.voxel_count,
        "dense_voxels": semantic_map.dense_voxel_count,
        "instances": semantic_map.instance_count,
        "bytes": semantic_map.nbytes(),
    }


def query(
    map_directory: Annotated[Path, typer.Argument(metavar="MAPDIR", help="A saved map.")],
    prompts: Prompts,
    top: Annotated[int | None, typer.Option("--top", min=1, help="Answers per prompt.")] = None,
    layer: Layer = "",
    negative: Negative = None,
    threshold: Annotated[float | None, typer.Option("--threshold", help="Leave out what scores less.")] = None,
    as_json: AnswerAsJson = False,
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
    defaults = info.config.query
    request = replace(request, top_k=top or defaults.top_k, min_voxels=defaults.min_voxels)
    text_encoder = load_text_encoder(info.encoder, "cpu", info.config.encoder.weights if weights is None else weights)
    answer = answer_query(semantic_map, text_encoder, request, info.logit_scale)
    print_answer(answer.instances, prompts, info.map_frame, as_json)
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
