"""The figures of vision models as tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

_WIDTH = 150
_BUSY = 0.05  # Of all cores' time: what others may take before figures are not to be trusted.
Figures = Mapping[str, Any]
"""A :class:`benchmarks.model_figures.ModelFigures` as JSON has it, with ``busy_with_others``, the share of all cores' time
that other processes had meanwhile; or kind, name and problem of a model that failed."""


def with_ratios(figures: Sequence[Figures]) -> list[dict[str, Any]]:
    """Add to each model the time of its frame over that of ``lite`` of its kind, where that was measured in the same run.

    Returns:
        Copies with ``frame_over_lite``, None where there is nothing to compare.
    """
    best = {model["kind"]: model["frame"]["best"] for model in figures if model["name"] == "lite" and "frame" in model}
    return [
        {**model, "frame_over_lite": model["frame"]["best"] / best[model["kind"]] if model["kind"] in best else None}
        if "frame" in model
        else dict(model)
        for model in figures
    ]


def print_models(figures: Sequence[Figures], console: Console) -> None:
    """Print trios and segmenters in a table each, and the models that failed under them."""
    console.width = max(console.width, _WIDTH)
    measured = [model for model in figures if "frame" in model]
    trios, segmenters = ([model for model in measured if model["kind"] == kind] for kind in ("trio", "segmenter"))
    if measured:
        first = measured[0]
        height, width = first["image_size"]
        console.print(
            f"Frames of {height}x{width} on {first['device']}, {first['threads']} threads. Seconds, best / median "
            "(samples); 2 FLOP for a product and its sum; M = 10^6, GB = 10^9 bytes; load from the page cache.",
            soft_wrap=True,
        )
    if trios:
        console.print(_trio_sizes(trios))
        console.print(_trio_times(trios))
    if segmenters:
        console.print(_segmenter_table(segmenters))
    for note in dict.fromkeys(note for model in measured for note in _notes(model)):
        console.print(note, soft_wrap=True)
    for model in figures:
        if "problem" in model:
            console.print(f"{model['kind']} {model['name']}: {model['problem']}", style="red", markup=False, soft_wrap=True)


def _trio_sizes(trios: Sequence[Figures]) -> Table:
    table = _table(
        "encoder trios: size and work",
        ("trio",),
        ("d", "image M", "text M", "frame px", "patches", "crop px", "GFLOP a frame", "GFLOP a crop"),
    )
    for model in trios:
        table.add_row(
            model["name"],
            str(model["dimension"]),
            _millions(model["image_parameters"]),
            _millions(model["text_parameters"]),
            _sides(model["frame_input"][2:]),
            _sides(model["patch_grid"]),
            _sides(model["crop_input"][2:]),
            _number(model["frame_gflop"]),
            _number(model["crop_gflop"]),
        )
    return table


def _trio_times(trios: Sequence[Figures]) -> Table:
    right = ("a frame", "/ lite's", "a crop", "in a batch of", "a prompt", *_last_names(trios))
    table = _table("encoder trios: time and memory", ("trio", "runtime"), right)
    for model in trios:
        estimated = model["prompt_measured_sentences"] < model["prompt_sentences"]
        table.add_row(
            model["name"],
            _runtime(model),
            _seconds(model["frame"]),
            _ratio(model),
            _seconds(model["crop"]),
            str(model["crop_batch"]),
            ("~ " if estimated else "") + _seconds(model["prompt"]),
            *_last_cells(model),
        )
    return table


def _segmenter_table(segmenters: Sequence[Figures]) -> Table:
    right = ("image M", "input px", "GFLOP a frame", "a frame", "/ lite's", *_last_names(segmenters))
    table = _table("segmenters", ("segmenter", "runtime"), right)
    for model in segmenters:
        table.add_row(
            model["name"],
            _runtime(model),
            _millions(model["image_parameters"]),
            _sides(model["frame_input"][2:]),
            _number(model["frame_gflop"]),
            _seconds(model["frame"]),
            _ratio(model),
            *_last_cells(model),
        )
    return table


def _table(title: str, left: Sequence[str], right: Sequence[str]) -> Table:
    table = Table(*left, title=title, title_justify="left")
    for name in right:
        table.add_column(name, justify="right")
    return table


def _last_names(models: Sequence[Figures]) -> tuple[str, ...]:
    on_device = any(model["peak_device_bytes"] is not None for model in models)
    return ("load", "loaded GB", "peak GB", *(("peak GB of torch, of GPU in use",) if on_device else ()))


def _last_cells(model: Figures) -> list[str]:
    loading = _number(model["load_s"]) + (f" + {_number(model['prepare_s'])}" if model["prepare_s"] >= 0.1 else "")
    cells = [loading, f"{model['loaded_resident_bytes'] / 1e9:.2f}", f"{model['peak_resident_bytes'] / 1e9:.2f}"]
    if model["peak_device_bytes"] is not None:
        cells.append(f"{model['peak_device_bytes'] / 1e9:.2f}, {model['device_in_use_bytes'] / 1e9:.2f}")
    return cells


def _runtime(model: Figures) -> str:
    return f"{model['runtime']} {model['precision']}"


def _notes(model: Figures) -> list[str]:
    notes = []
    others = model.get("busy_with_others", 0.0)
    if others > _BUSY:
        notes.append(f"{model['kind']} {model['name']}: meanwhile other processes took {100 * others:.0f} % of the cores.")
    if model["prompt_sentences"] and model["prompt_measured_sentences"] < model["prompt_sentences"]:
        notes.append(
            f"~ {model['name']}: a prompt is embedded in {model['prompt_sentences']} sentences, of which "
            f"{model['prompt_measured_sentences']} were timed."
        )
    if model["weights"] == "random" and model["kind"] == "segmenter" and model["name"] == "sam2":
        notes.append(
            "sam2: random weights propose next to no masks, so that bringing them to the frame's size is not in it."
        )
    if model["code"] == "stand-in":
        notes.append(f"{model['name']}: the tests' stand-in for RADIO's code built the transformer of the same size.")
    if model["name"] == "lite":
        notes.append("lite: with its detector; a crop is embedded after the detector's run.")
    return notes


def _seconds(times: Mapping[str, Any]) -> str:
    return f"{_number(times['best'])} / {_number(times['median'])} ({times['samples']})"


def _sides(sides: Sequence[int]) -> str:
    return "x".join(map(str, sides))


def _millions(count: int | None) -> str:
    return "" if count is None else f"{count / 1e6:.1f}"


def _ratio(model: Figures) -> str:
    return "" if model.get("frame_over_lite") is None else _number(model["frame_over_lite"])


def _number(value: float) -> str:
    return f"{value:,.0f}" if value >= 1000 else f"{value:.3g}"
