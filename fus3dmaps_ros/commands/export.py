"""``fus3dmaps export``: writes the networks of an encoder trio as checked ONNX files, and as TensorRT engines if possible.

Needs no ROS.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console

from fus3dmaps_core.config.schema import Config, EncoderConfig
from fus3dmaps_core.errors import EncoderError
from fus3dmaps_ros.commands.settings import ParamsFile, Settings, configuration, directory
from fus3dmaps_ros.commands.terminal import OUT

if TYPE_CHECKING:
    from fus3dmaps_core.runtimes.exporting import ExportedGraph

_MIB = 1 << 20


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
    chosen = {"encoder.name": encoder, "encoder.precision": precision}
    config = configuration(params_file, settings).with_values(
        {key: value for key, value in chosen.items() if value is not None}
    )
    export_encoders(config, out, OUT, as_json=as_json)


def export_encoders(config: Config, directory: Path, console: Console, *, as_json: bool = False) -> None:
    """Export the graphs of both image encoders, check them, and print the figures of each.

    Without TensorRT, or without a GPU, only ONNX files are written, and a line says what is missing.

    Args:
        config: ``encoder.name``, ``weights``, ``device`` and ``precision`` say what to export, ``image.height`` and
            ``width`` for which images. Engines are built on the device if it is a CUDA device, else on the first one.
        directory: Where the files go; later ``encoder.graph_directory`` of the node that runs them.
        console: Gets the output.
        as_json: Print one JSON object, ``graphs`` and ``engines``, instead of lines.

    Raises:
        EncoderError: The trio or its weights are missing, an encoder has no graph, the directory cannot be written, memory
            does not suffice for images of that size, or a graph is too far from torch.
    """
    # These take seconds to import.
    from fus3dmaps_core.encoders.registry import load_trio
    from fus3dmaps_core.runtimes.exporting import export_graph, graph_encoders
    from fus3dmaps_core.runtimes.image_memory import naming_image_size

    encoder, image, exported = config.encoder, config.image, []
    trio = load_trio(encoder.name, encoder.device, config.segmenter.crop_padding, encoder.weights)
    for named in graph_encoders(trio):
        with naming_image_size(trio.name, image.height, image.width):
            exported.append(export_graph(named, encoder.precision, directory, image.height, image.width))
        if not as_json:
            _say(console, _graph_line(exported[-1]))
    engines, note = _build_engines(encoder, directory, exported)
    if as_json:
        content = {"graphs": [_graph_values(found) for found in exported], "engines": [str(path) for path in engines]}
        _say(console, json.dumps(content | ({"note": note} if note else {}), indent=2))
    else:
        for line in [*(f"engine: {path}" for path in engines), *([note] if note else [])]:
            _say(console, line)


def _build_engines(encoder: EncoderConfig, directory: Path, exported: list[ExportedGraph]) -> tuple[list[Path], str]:
    """Build the engines of the graphs; return them, and if there are none a line that says why."""
    import torch

    from fus3dmaps_core.runtimes.packages import import_tensorrt
    from fus3dmaps_core.runtimes.tensorrt_network import engine_of

    try:
        import_tensorrt()
    except EncoderError as error:
        return [], f"no engines: {error}"
    if not _has_gpu():
        return [], "no engines: they are built on the GPU that runs them, and torch finds none here"
    device = encoder.device if torch.device(encoder.device).type == "cuda" else "cuda"
    return [engine_of(found.path, device, encoder.precision, directory)[1] for found in exported], ""


def _has_gpu() -> bool:
    import torch

    return torch.cuda.is_available()


def _graph_line(found: ExportedGraph) -> str:
    parity = found.parity
    further = "".join(f", {name} within {value:.2g}" for name, value in parity.further.items())
    return (
        f"{found.name}: {found.path} ({found.size_bytes / _MIB:.1f} MiB, opset {found.opset}, "
        f"input {'x'.join(map(str, found.shape))}, {found.parameters / 1e6:.1f} M parameters, {found.precision}); "
        f"cosine error max {parity.largest:.2e} (bound {parity.bound.largest:.0e}), mean {parity.mean:.2e} "
        f"(bound {parity.bound.mean:.0e}){further}"
    )


def _graph_values(found: ExportedGraph) -> dict[str, Any]:
    parity = found.parity
    return {
        "name": found.name,
        "path": str(found.path),
        "size_bytes": found.size_bytes,
        "opset": found.opset,
        "shape": list(found.shape),
        "precision": found.precision,
        "parameters": found.parameters,
        "max_cosine_error": parity.largest,
        "max_cosine_error_bound": parity.bound.largest,
        "mean_cosine_error": parity.mean,
        "mean_cosine_error_bound": parity.bound.mean,
        "further_outputs": parity.further,
    }


def _say(console: Console, line: str) -> None:
    console.print(line, markup=False, soft_wrap=True, highlight=False)
