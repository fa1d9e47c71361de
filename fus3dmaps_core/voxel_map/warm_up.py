"""A rehearsal of everything that a map does, so that its first keyframe takes no longer than the others.

A loop is compiled at its first call (all of them in some fifteen seconds) and loaded from a cache after that. A GPU loads
its kernels at their first call too.
"""

from __future__ import annotations

import numpy as np

from fus3dmaps_core.config.schema import MapConfig
from fus3dmaps_core.voxel_map.layer_query import LayerQuery
from fus3dmaps_core.voxel_map.layers.similarity import LAYERS
from fus3dmaps_core.voxel_map.semantic_map import SemanticMap


def warm_up(dimension: int, config: MapConfig) -> None:
    """Run every operation once on a small map of the same configuration, then throw the map away.

    Args:
        dimension: Embedding width d.
        config: Names the storage type, the device and the kernels of the map that will be used.
    """
    points_m = config.voxel_size_m * (np.arange(12.0).reshape(4, 3) + 0.5)
    embeddings = np.ones((2, dimension), np.float32)
    index, weights, colors = np.arange(4) // 2, np.ones(2, np.float32), np.zeros((4, 3), np.uint8)
    for window_radius_m in (0.0, 6.0 * config.voxel_size_m):
        rehearsal = SemanticMap(dimension, config, 1.0, window_radius_m)
        for dtype in (np.float32, np.float64):
            rehearsal.integrate_dense(points_m.astype(dtype), index, embeddings.astype(dtype), weights, colors)
        rehearsal.integrate_proposals(points_m, index, embeddings)
        for layer in LAYERS:
            for prompts in (embeddings, embeddings[:1]):
                rehearsal.search(LayerQuery(layer, prompts, embeddings))
        rehearsal.fuse()
        rehearsal.voxels()
        rehearsal.instances()
        rehearsal.import_state(rehearsal.export_state())
        rehearsal.prune_window(points_m[0])
        rehearsal.remove_voxels(points_m)
