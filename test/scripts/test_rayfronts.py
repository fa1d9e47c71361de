"""The adapter to RayFronts, against a stand-in of the same layout."""

from __future__ import annotations

import sys
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest
import torch
from benchmarks.engine import Run
from benchmarks.rayfronts import Peer, load_map_class, measure_rayfronts, scatter

from fus3dmaps_core.errors import ConfigError


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A checkout whose map appends rows; its package files would fail if they were run."""
    for name in [name for name in sys.modules if name.split(".")[0] in ("rayfronts", "torch_scatter")]:
        monkeypatch.delitem(sys.modules, name)
    package = tmp_path / "rayfronts"
    (package / "mapping").mkdir(parents=True)
    for folder in (package, package / "mapping"):
        (folder / "__init__.py").write_text("raise RuntimeError('models and viewers')")
    (package / "geometry3d.py").write_text("import torch_scatter")
    (package / "mapping" / "semantic_voxel_map.py").write_text(
        dedent(
            """
            import torch
            from rayfronts import geometry3d, image_encoders, visualizers, feat_compressors

            class SemanticVoxelMap:
                viewer: visualizers.Mapping3DVisualizer = None

                def __init__(self, intrinsics_3x3, device, vox_size, vox_accum_period, windowing):
                    assert (vox_size, vox_accum_period) == (0.05, 1)
                    self.windowing = windowing
                    self._tmp_pc_xyz, self._tmp_pc_rgb_feat_conf = [], []
                    self.global_vox_xyz = torch.zeros((0, 3))

                def accum_semantic_voxels(self):
                    xyz, rows = torch.cat(self._tmp_pc_xyz), torch.cat(self._tmp_pc_rgb_feat_conf)
                    assert len(xyz) == len(rows)
                    self.global_vox_xyz = torch.cat([self.global_vox_xyz, xyz])
                    self._tmp_pc_xyz.clear()
                    self._tmp_pc_rgb_feat_conf.clear()
            """
        )
    )
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if name.split(".")[0] in ("rayfronts", "torch_scatter"):
            del sys.modules[name]


def test_folder_without_a_checkout_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="is no checkout of RayFronts"):
        load_map_class(tmp_path)


def test_checkout_that_does_not_import_is_refused(checkout):
    (checkout / "rayfronts" / "geometry3d.py").write_text("import something_that_is_not_there")
    with pytest.raises(ConfigError, match="something_that_is_not_there"):
        load_map_class(checkout)


def test_rows_hold_colour_features_and_confidence_at_points_of_their_grid(checkout):
    peer = Peer(load_map_class(checkout), windowed=True, device="cpu")
    points = np.array([[0.02, -0.03, 0.26]])  # In our voxel (0, -1, 5).
    xyz, rows = peer.prepare(points, torch.tensor([[0.5, 0.25]]), np.array([[255, 0, 51]], np.uint8))
    assert torch.round(xyz / 0.05).int().tolist() == [[0, -1, 5]]
    assert rows.tolist() == [pytest.approx([1.0, 0.0, 0.2, 0.5, 0.25, 1.0])]
    peer.update(xyz, rows)
    assert peer.voxels == 1
    assert peer.map.windowing is True


def test_both_modes_are_measured_at_every_size(checkout, world):
    run = Run(world, "cpu", None, 1, 1, lambda text: None)
    figures = measure_rayfronts(run, checkout, world.dense_8k[:2], [2000, 3000], 8)
    assert [(f.params["map_voxels"], f.params["windowed"]) for f in figures] == [
        (2000, False),
        (2000, True),
        (3000, False),
        (3000, True),
    ]
    assert {(f.name, f.unit, f.params["points"], f.params["d"]) for f in figures} == {("rayfronts_update", "ms", 8000, 8)}


def test_scatter_adds_and_averages_like_a_loop():
    rng = np.random.default_rng(2)
    src, index = rng.normal(size=(50, 3)), rng.integers(0, 6, 50)
    index[index == 4] = 5  # One row that nothing is added to.
    for reduce in ("sum", "mean"):
        expected = np.zeros((6, 3))
        for row in set(index.tolist()):
            members = src[index == row]
            expected[row] = members.sum(axis=0) if reduce == "sum" else members.mean(axis=0)
        out = torch.zeros((6, 3), dtype=torch.float64)
        scatter(torch.from_numpy(src), torch.from_numpy(index), out, reduce, 0)
        assert out.numpy() == pytest.approx(expected)


def test_other_reductions_are_refused():
    with pytest.raises(NotImplementedError):
        scatter(torch.zeros(1, 1), torch.zeros(1, dtype=torch.int64), torch.zeros(1, 1), "max", 0)
