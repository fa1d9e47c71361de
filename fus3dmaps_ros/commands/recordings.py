"""``fus3dmaps convert`` and ``fus3dmaps simulate``: recordings of datasets and of simulated rooms. No ROS."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fus3dmaps_lab.datasets.registry import names as dataset_names
from fus3dmaps_ros.commands.settings import DatasetOptions, pairs
from fus3dmaps_ros.commands.terminal import OUT, progress

if TYPE_CHECKING:
    from fus3dmaps_core.frame import PosedFrame

Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace what is there.")]


def convert(
    dataset: Annotated[str, typer.Argument(help=f"Layout of the folder: {', '.join(dataset_names())}.")],
    directory: Annotated[Path, typer.Argument(help="The dataset's folder.")],
    out: Annotated[Path, typer.Argument(help="Recording to write, ending in .mcap.")],
    overwrite: Overwrite = False,
    options: DatasetOptions = None,
) -> None:
    """Turn a dataset into a rosbag2 MCAP recording."""
    from fus3dmaps_lab.datasets.convert import convert as convert_dataset

    with progress("writing frames") as update:
        summary = convert_dataset(
            dataset, directory, out, overwrite=overwrite, on_progress=update, options=pairs("--option", options)
        )
    OUT.print(
        f"{out}: {summary.frames} frames, {summary.duration_s:.1f} s of recording, {summary.size_bytes / 1e6:.0f} MB",
        markup=False,
        soft_wrap=True,
    )


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
    with progress("rendering frames") as update, RecordingWriter(out, overwrite=overwrite) as writer:
        for done, frame in enumerate(source, start=1):
            writer.write(frame)
            update(done, count)
    OUT.print(f"{out}: {count} frames", markup=False, soft_wrap=True)
