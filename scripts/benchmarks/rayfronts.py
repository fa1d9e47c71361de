"""The dense peer: RayFronts' own map update, imported from a checkout of it, on the input that our dense update gets.

Its vision models, viewers and compressors are replaced by names without content: an update of the map calls none of them.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.boxes import VOXEL_SIZE_M
from benchmarks.embeddings import ObservedObjects
from benchmarks.engine import Run
from benchmarks.keyframes import DenseKeyframe, object_colors
from benchmarks.measurements import Measurement, timed
from benchmarks.timing import Times, time_calls
from fus3dmaps_core.errors import ConfigError

PREFILLED = (17_000, 200_000)
"""Voxels that its map holds before the clock starts."""

_MAP_MODULE = Path("rayfronts", "mapping", "semantic_voxel_map.py")
# What RayFronts' modules name when they are imported and never use in an update of the map.
_HOLLOW = {
    "rayfronts.visualizers": ("Mapping3DVisualizer",),
    "rayfronts.image_encoders": ("ImageSpatialEncoder",),
    "rayfronts.feat_compressors": ("FeatCompressor",),
}


def check_checkout(directory: Path) -> None:
    """Raise ConfigError unless the directory is a checkout of RayFronts."""
    if not (directory / _MAP_MODULE).is_file():
        raise ConfigError(f"--rayfronts {directory}: is no checkout of RayFronts, {_MAP_MODULE} is missing")


def load_map_class(directory: Path) -> type[Any]:
    """Import SemanticVoxelMap, and what it needs, from a checkout.

    Raises:
        ConfigError: The directory is no checkout of RayFronts, or one that this adapter does not know.
    """
    check_checkout(directory)
    # Packages without their __init__: those import every model and viewer there is.
    for name in ("rayfronts", "rayfronts.mapping"):
        package = ModuleType(name)
        package.__path__ = [str(directory.resolve() / name.replace(".", "/"))]
        sys.modules[name] = package
    for name, classes in _HOLLOW.items():
        hollow = ModuleType(name)
        for class_name in classes:
            setattr(hollow, class_name, type(class_name, (), {}))
        sys.modules[name] = hollow
        setattr(sys.modules["rayfronts"], name.rpartition(".")[2], hollow)
    if "torch_scatter" not in sys.modules and importlib.util.find_spec("torch_scatter") is None:
        stand_in = ModuleType("torch_scatter")
        stand_in.scatter = scatter  # type: ignore[attr-defined]
        sys.modules["torch_scatter"] = stand_in
    try:
        module = importlib.import_module("rayfronts.mapping.semantic_voxel_map")
        return module.SemanticVoxelMap  # type: ignore[no-any-return]
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"--rayfronts {directory}: cannot be imported: {error}") from None


def scatter(src: Tensor, index: Tensor, out: Tensor, reduce: str, dim: int) -> Tensor:
    """Do what torch_scatter's function of this name does with these arguments, by torch's own scatter_add_.

    Args:
        src: (n, c) values.
        index: (n,) row of ``out`` that each is added to.
        out: (m, c), changed in place.
        reduce: "sum" or "mean".
        dim: 0.
    """
    if dim != 0 or reduce not in ("sum", "mean"):
        raise NotImplementedError(f"scatter by {reduce} along {dim}")
    out.scatter_add_(0, index[:, None].expand_as(src), src)
    if reduce == "mean":
        out /= torch.bincount(index, minlength=len(out)).clamp_(min=1)[:, None]
    return out


class Peer:
    """RayFronts' map, filled and updated with our points."""

    def __init__(self, map_class: type[Any], windowed: bool, device: str) -> None:
        """Start empty, merging every keyframe into the map at once."""
        self._device = device
        self.map = map_class(None, device, vox_size=VOXEL_SIZE_M, vox_accum_period=1, windowing=windowed)

    def prepare(self, points_m: np.ndarray, features: Tensor, colors: np.ndarray) -> tuple[Tensor, Tensor]:
        """Make points and their rows of colour, features and confidence as its own process_posed_rgbd does.

        Its voxels are centred on multiples of their size where ours begin there: half a voxel's shift makes them the same.
        """
        xyz = torch.from_numpy(points_m - 0.5 * VOXEL_SIZE_M).to(self._device, torch.float32)
        rgb = torch.from_numpy(colors).to(self._device, torch.float32) / 255
        return xyz, torch.cat((rgb, features, torch.ones((len(xyz), 1), device=self._device)), dim=1)

    def update(self, xyz: Tensor, rows: Tensor) -> None:
        """Update the map by one keyframe."""
        self.map._tmp_pc_xyz.append(xyz)
        self.map._tmp_pc_rgb_feat_conf.append(rows)
        self.map.accum_semantic_voxels()

    @property
    def voxels(self) -> int:
        """Rows of its map; a windowed one may hold a voxel more than once."""
        return len(self.map.global_vox_xyz)


def measure_rayfronts(
    run: Run, directory: Path, keyframes: Sequence[DenseKeyframe], sizes: Sequence[int], dimension: int
) -> list[Measurement]:
    """Measure rayfronts_update: one keyframe into its map, in float32 as it stores it, full and windowed."""
    map_class = load_map_class(directory)
    observed = ObservedObjects(dimension, run.world.seed)
    measured = []
    for voxels in sizes:
        for windowed in (False, True):
            run.say(f"RayFronts, {voxels:,} voxels, d {dimension}{', windowed' if windowed else ''}")
            peer = Peer(map_class, windowed, run.device)
            _prefill(peer, run, voxels, observed)
            inputs = [
                peer.prepare(
                    keyframe.points_m,
                    torch.from_numpy(observed.observe(keyframe.patch_objects)).to(run.device)[keyframe.patches],
                    keyframe.colors,
                )
                for keyframe in keyframes
            ]
            times = _time_updates(peer, inputs, run.device)
            hit = round(float(np.mean([keyframe.voxels for keyframe in keyframes])))
            further = {"points": len(keyframes[0].points_m), "voxels_hit": hit, "keyframes": len(keyframes)}
            params = run.params(voxels, dimension, "float32", **further, windowed=windowed, rows=peer.voxels)
            measured.append(timed("rayfronts_update", {**params, "backend": "rayfronts"}, times))
            del peer, inputs
    return measured


def _time_updates(peer: Peer, inputs: Sequence[tuple[Tensor, Tensor]], device: str) -> Times:
    return time_calls(lambda index: peer.update(*inputs[index]), len(inputs), 1, device=device)


def _prefill(peer: Peer, run: Run, voxels: int, observed: ObservedObjects) -> None:
    surface = run.world.surface
    objects = surface.objects[:voxels]
    features = torch.from_numpy(observed.observe(objects)).to(run.device)
    peer.update(*peer.prepare(surface.points_m[:voxels], features, object_colors(objects)))
