"""Made-up results in which every claim holds; tests change them to make a claim fail."""

from __future__ import annotations

import math

import numpy as np

from fus3dmaps_lab.evaluation.records import CurvePoint, Record

SCENE = "simulated building"
SEEDS = range(5)
CLASSES = ("bed", "cup", "sofa")
LAMBDAS = (0.01, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 100.0)
LEVELS = {
    ("dense", "full"): 0.42,
    ("fused_dense", "full"): 0.45,
    ("instances", "full"): 0.40,
    ("instances", "window"): 0.40,
    ("fused_instances", "full"): 0.50,
    ("fused_instances", "window"): 0.495,
    ("fused_instances", "window_no_evidence"): 0.46,
}
SCORES = ("mIoU", "f-mIoU", "accuracy", "mean_accuracy")
BYTES_PER_M3 = 2.0e7


def made_up_records(scene=SCENE, seeds=SEEDS, **levels):
    """Make scores of every layer and mode; ``levels``, named ``layer__mode``, override LEVELS."""
    found = []
    for (layer, mode), level in LEVELS.items():
        level = levels.get(f"{layer}__{mode}", level)
        for seed in seeds:
            wobble = 0.01 * math.sin(7 * seed) + 0.001 * math.sin(13 * seed + 5 * len(layer) + len(mode))
            found += [Record(scene, seed, layer, mode, metric, level + wobble + 0.1 * i) for i, metric in enumerate(SCORES)]
            if "dense" in layer:
                found += [Record(scene, seed, layer, mode, f"{metric}_with_background", level + wobble) for metric in SCORES]
            found += [Record(scene, seed, layer, mode, f"iou/{name}", level + wobble) for name in CLASSES]
            found.append(Record(scene, seed, layer, mode, "AP25", level))
    return found


def lambda_points(best_at=None, ratios=(0.2, 1.0, 5.0)):
    """Make sweeps that are best at their ratio, or at ``best_at[ratio]``."""
    return [
        CurvePoint(
            "lambda",
            f"R^D / R^I = {ratio:g}",
            seed,
            x,
            "mIoU",
            0.5 + 0.01 * seed - 0.02 * np.log10(x / (best_at or {}).get(ratio, ratio)) ** 2,
        )
        for ratio in ratios
        for seed in SEEDS
        for x in LAMBDAS
    ]


def memory_points(slope=1.0, bend=0.0, window_share=0.1):
    """Make a dense map whose bytes rise by ``slope`` times the prediction, and a window that ends at a share of them."""
    points = []
    for volume in (100.0, 400.0, 700.0, 1000.0):
        dense = BYTES_PER_M3 * (slope * volume + bend * volume**2)
        for seed in (0, 1):
            points.append(CurvePoint("memory", "dense map", seed, volume, "bytes", dense))
            points.append(CurvePoint("memory", "sliding window", seed, volume, "bytes", dense * window_share))
        points.append(CurvePoint("memory", "predicted", 0, volume, "bytes", BYTES_PER_M3 * volume))
    return points


def window_points():
    """Make two layers at four radii, and the whole dense layer as radius 0."""
    return [
        CurvePoint("window_radius", layer, seed, radius, metric, level - (0.1 / radius if radius else 0) + 0.01 * seed)
        for layer, level in (("fused_instances", 0.5), ("instances", 0.4))
        for seed in SEEDS
        for radius in (1.0, 2.0, 4.0, 6.0, 0.0)
        for metric in ("mIoU", "accuracy")
    ]


def association_points(**better):
    """Make three ways to associate; ``better`` adds to a metric of ``visible IoU 0.2``."""
    levels = {"IoU 0.2": 0.40, "visible IoU 0.2": 0.45, "IoU 0.2 + merging": 0.42}
    points = []
    for way, level in levels.items():
        for metric in ("mIoU", "AP25"):
            extra = better.get(metric, 0.0) if way == "visible IoU 0.2" else 0.0
            points += [CurvePoint("association", way, s, 0.0, metric, level + extra + 0.01 * s) for s in SEEDS]
        points += [CurvePoint("association", way, s, 0.0, "instances", 200 * level + s) for s in SEEDS]
    return points


def all_points():
    """Make points of every experiment."""
    return [*lambda_points(), *memory_points(), *window_points(), *association_points()]
