"""Graphs that others exported, rounded to half precision as those of our own encoders are, so that TensorRT obeys it."""

from __future__ import annotations

import logging
import tempfile
from importlib import import_module
from pathlib import Path

import torch
from torch.nn import functional

from fus3dmaps_core.config.schema import Precision
from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.runtimes.cached_files import graph_hash, slug
from fus3dmaps_core.runtimes.graph_files import checksum_path, is_whole, write_checksum
from fus3dmaps_core.runtimes.half_precision import emulate_products, round_products
from fus3dmaps_core.runtimes.onnx_network import OnnxNetwork
from fus3dmaps_core.runtimes.packages import check_exporter
from fus3dmaps_core.runtimes.parity import BOUNDS
from fus3dmaps_core.runtimes.static_batches import listed

_HASH_DIGITS = 16

_log = logging.getLogger(__name__)


def in_precision(path: Path, precision: Precision, directory: Path, images: torch.Tensor) -> Path:
    """Round the products of a float32 graph to half precision, unless that was done before, and compare the two.

    Args:
        path: ONNX file of a float32 graph with one input of static shape.
        precision: ``fp32`` gives the file itself.
        directory: Where the other file is kept; made if it is missing.
        images: (n, channels, H, W) float32 on the CPU, such as the network gets.

    Raises:
        EncoderError: A package is missing, the graph cannot be rounded, the directory cannot be written, or the outputs are
            farther apart than graphs of our own may be in that precision, channel by channel.
    """
    if precision == "fp32":
        return path
    check_exporter()
    rounded = directory / f"{slug(path.stem)}_{precision}_{graph_hash(path)[:_HASH_DIGITS]}.onnx"
    if is_whole(rounded):
        return rounded
    _log.info("taking the products of '%s' in %s: '%s'", path, precision, rounded)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=directory, prefix=".round-") as folder:
            written = Path(folder) / rounded.name
            _round(path, precision, written)
            _check(path, precision, written, images)
            write_checksum(written)
            checksum_path(written).replace(checksum_path(rounded))
            written.replace(rounded)
    except OSError as error:
        raise EncoderError(
            f"parameter 'encoder.graph_directory': cannot write '{rounded}': {error.strerror or error}"
        ) from None
    return rounded


def _round(path: Path, precision: Precision, written: Path) -> None:
    ir, passes = import_module("onnx_ir"), import_module("onnx_ir.passes.common")
    model = ir.load(path)
    passes.ShapeInferencePass()(model)  # Rounding asks for types, which a file need not have.
    round_products(ir, model, precision)
    ir.save(model, written)


def _check(path: Path, precision: Precision, written: Path, images: torch.Tensor) -> None:
    """Compare both files as :func:`fus3dmaps_core.runtimes.parity.check_parity` does, over the values of each channel."""
    ir = import_module("onnx_ir")
    model = ir.load(written)
    emulate_products(ir, model, precision)
    emulated = written.with_name(f"emulated_{written.name}")
    ir.save(model, emulated)
    expected, found = (listed(OnnxNetwork(file, "cpu")(images)) for file in (path, emulated))
    errors = torch.cat([_channel_errors(one, other) for one, other in zip(expected, found, strict=True)])
    bound, largest, mean = BOUNDS[precision], float(errors.max()), float(errors.mean())
    if not (largest <= bound.largest and mean <= bound.mean):  # NaN is above every bound.
        raise EncoderError(
            f"graph '{path}' in {precision}: cosine error of a channel {largest:.3g}, mean {mean:.3g}, above the bounds of "
            f"{bound.largest:.3g} and {bound.mean:.3g}; take another 'encoder.precision', e.g. fp32"
        )


def _channel_errors(expected: torch.Tensor, found: torch.Tensor) -> torch.Tensor:
    """Compute 1 - cos over all that follows the second axis, flat; of two channels of zeros, 0."""
    one, other = (values.double().flatten(2).flatten(0, 1) for values in (expected, found))
    both_zero = ~(one.any(dim=1) | other.any(dim=1))
    return torch.where(both_zero, 0.0, 1.0 - functional.cosine_similarity(one, other, dim=1))
