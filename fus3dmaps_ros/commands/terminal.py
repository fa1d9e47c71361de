"""What the commands share: two consoles, progress bars, tables of answers, and the check for ROS."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from fus3dmaps_core.errors import ConfigError

if TYPE_CHECKING:
    from fus3dmaps_core.answers.query import RankedInstance

OUT = Console(highlight=False)
"""Results: standard output."""

LOG = Console(stderr=True, highlight=False)
"""Progress, warnings and refusals: standard error."""


def need_ros() -> None:
    """Raise ConfigError, with what to do, unless ROS 2 can be imported."""
    try:
        import rclpy  # noqa: F401
    except ImportError as error:
        raise ConfigError(
            f"this command needs ROS 2: {error}; source a Jazzy installation or run scripts/setup.sh"
        ) from None


@contextmanager
def progress(label: str) -> Iterator[Callable[[int, int], None]]:
    """Show a progress bar; the block gets a function that takes the numbers done and in all."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TaskProgressColumn(),
        TimeRemainingColumn(),
    )
    bar = Progress(*columns, console=LOG)
    task = bar.add_task(label, total=None)

    def update(done: int, total: int) -> None:
        bar.start()  # Not before there is something to show: a refusal is to stand alone.
        bar.update(task, completed=done, total=total)

    try:
        yield update
    finally:
        bar.stop()


def print_answer(instances: Sequence[RankedInstance], prompts: Sequence[str], frame: str, as_json: bool) -> None:
    """Print ranked instances, best first: a table for each prompt, or one JSON list."""
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
        OUT.print(table)


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
