"""The numbers reported by FUS3DMaps (Homberger et al.), row by row, for comparison with ours.

Metrics have the names of our records: the paper's fmIoU is ``f-mIoU``, its Acc and mAcc are ``accuracy`` (its protocol
computes the share of right voxels). Its results on a dataset are averages over that dataset's scenes, listed in SCENES.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import product

REPLICA, SCANNET, HM3DSEM = "Replica", "ScanNet", "HM3DSem"
NARADIO, CLIP_DINOISER = "FUS3DMaps, NARADIO", "FUS3DMaps, CLIP-DINOiser"

SCENES: dict[str, tuple[str, ...]] = {
    REPLICA: ("office0", "office1", "office2", "office3", "office4", "room0", "room1", "room2"),
    SCANNET: ("0011", "0050", "0231", "0378", "0518"),
    HM3DSEM: ("00824", "00829", "00843", "00847", "00873", "00877", "00890"),
}
"""Scenes that the paper averages over, by dataset."""

TABLES = (
    "instance maps",
    "dense maps",
    "ablation of instance maps",
    "ablation of dense maps",
    "lambda",
    "HM3DSem",
    "memory",
    "frame rates",
)
"""Names of the paper's tables here, in its order."""

_METRICS = ("mIoU", "f-mIoU", "accuracy")


@dataclass(frozen=True)
class PaperRow:
    """One number of the paper.

    Attributes:
        table: One of TABLES.
        dataset: Dataset of the average, or the scene of a memory measurement.
        method: Method that made the map.
        layer: One of the records' LAYERS; ``all`` for what belongs to the whole map.
        mode: One of the records' MODES; ``no fusion`` for a frame rate while nothing is fused.
        background: Whether background classes count (for instance layers they never do); None if classes do not matter.
        metric: ``mIoU``, ``f-mIoU``, ``accuracy``, ``MiB`` or ``Hz``.
        value: The number.
        variance_ratio: Lambda of the sweep, None elsewhere.
        device: Device of a frame rate, else empty.
    """

    table: str
    dataset: str
    method: str
    layer: str
    mode: str
    background: bool | None
    metric: str
    value: float
    variance_ratio: float | None = None
    device: str = ""


def _scores(
    table: str, method: str, layer: str, columns: Iterable[tuple[str, bool]], values: str, mode: str = "full"
) -> Iterator[PaperRow]:
    """Make the rows of one method: a line of values per metric, a column per dataset and handling of background."""
    lines = zip(_METRICS, values.strip().splitlines(), strict=True)
    for metric, line in lines:
        for (dataset, background), value in zip(columns, line.split(), strict=True):
            yield PaperRow(table, dataset, method, layer, mode, background, metric, float(value))


def _instance_maps() -> Iterator[PaperRow]:
    columns = ((REPLICA, False), (SCANNET, False))
    # OpenVox is told the classes beforehand, through its detector; the others are not.
    for method, mode, values in (
        ("OpenVox", "full", "0.2427 0.4449 \n 0.5361 0.5466 \n 0.5995 0.6181"),
        ("ConceptGraphs", "full", "0.1163 0.2162 \n 0.1661 0.2432 \n 0.1980 0.3104"),
        ("HOV-SG", "full", "0.1693 0.2679 \n 0.3145 0.3605 \n 0.3474 0.4417"),
        ("Open-Fusion", "full", "0.1848 0.2997 \n 0.4364 0.3958 \n 0.4887 0.4552"),
        (NARADIO, "full", "0.3137 0.4689 \n 0.5627 0.5231 \n 0.6522 0.6316"),
        (NARADIO, "window", "0.3237 0.4671 \n 0.5648 0.5161 \n 0.6519 0.6250"),
    ):
        layer = "fused_instances" if method == NARADIO else "instances"
        yield from _scores("instance maps", method, layer, columns, values, mode)


def _dense_maps() -> Iterator[PaperRow]:
    columns = tuple(product((REPLICA, SCANNET), (False, True)))
    for method, layer, values in (
        (
            "ConceptFusion",
            "dense",
            "0.2107 0.2038 0.2176 0.1857 \n 0.3151 0.3575 0.2671 0.2306 \n 0.3565 0.4158 0.3413 0.2877",
        ),
        (
            "RayFronts",
            "dense",
            "0.3937 0.2773 0.4129 0.3229 \n 0.6203 0.4337 0.4642 0.3904 \n 0.6880 0.5445 0.5676 0.4915",
        ),
        (
            NARADIO,
            "fused_dense",
            "0.4117 0.2940 0.4303 0.3352 \n 0.6416 0.4615 0.4801 0.3923 \n 0.7095 0.5695 0.5765 0.4959",
        ),
    ):
        yield from _scores("dense maps", method, layer, columns, values)


def _instance_ablation() -> Iterator[PaperRow]:
    columns = ((REPLICA, False), (SCANNET, False))
    for method, layer, values in (
        (NARADIO, "instances", "0.2665 0.3808 \n 0.4905 0.4227 \n 0.5687 0.5113"),
        (NARADIO, "fused_instances", "0.3137 0.4689 \n 0.5627 0.5231 \n 0.6522 0.6316"),
        (CLIP_DINOISER, "instances", "0.2499 0.3382 \n 0.4203 0.4424 \n 0.4803 0.5085"),
        (CLIP_DINOISER, "fused_instances", "0.2455 0.3741 \n 0.4300 0.4619 \n 0.4974 0.5350"),
    ):
        yield from _scores("ablation of instance maps", method, layer, columns, values)


def _dense_ablation() -> Iterator[PaperRow]:
    columns = tuple(product((REPLICA, SCANNET), (False, True)))
    for method, layer, values in (
        (
            NARADIO,
            "dense",
            "0.4016 0.2911 0.4045 0.3226 \n 0.6172 0.4480 0.4635 0.3879 \n 0.6848 0.5533 0.5610 0.4897",
        ),
        (
            NARADIO,
            "fused_dense",
            "0.4117 0.2940 0.4303 0.3352 \n 0.6416 0.4615 0.4801 0.3923 \n 0.7095 0.5695 0.5765 0.4959",
        ),
        (
            CLIP_DINOISER,
            "dense",
            "0.1256 0.1558 0.2902 0.2769 \n 0.3359 0.3777 0.3582 0.3450 \n 0.3986 0.4705 0.4370 0.4397",
        ),
        (
            CLIP_DINOISER,
            "fused_dense",
            "0.2657 0.2262 0.3610 0.3014 \n 0.4684 0.4053 0.4397 0.3447 \n 0.5204 0.4975 0.5059 0.4306",
        ),
    ):
        yield from _scores("ablation of dense maps", method, layer, columns, values)


def _lambda_sweep() -> Iterator[PaperRow]:
    sweeps = {
        NARADIO: "0.391 0.389 0.391 0.381 0.366 \n 0.532 0.532 0.543 0.517 0.504 \n 0.630 0.630 0.642 0.610 0.594",
        CLIP_DINOISER: "0.243 0.257 0.306 0.310 0.296 \n 0.379 0.404 0.444 0.446 0.439 \n 0.464 0.490 0.525 0.516 0.506",
    }
    for method, values in sweeps.items():
        for metric, line in zip(_METRICS, values.splitlines(), strict=True):
            for ratio, value in zip((0.1, 0.2, 1.0, 5.0, 10.0), line.split(), strict=True):
                yield PaperRow(
                    "lambda",
                    f"{REPLICA} and {SCANNET}",
                    method,
                    "fused_instances",
                    "full",
                    background=False,
                    metric=metric,
                    value=float(value),
                    variance_ratio=ratio,
                )


def _hm3dsem() -> Iterator[PaperRow]:
    columns = ((HM3DSEM, False),)
    for method, layer, mode, values in (
        ("Open-Fusion", "instances", "full", "0.2587 \n 0.3031 \n 0.3797"),
        (NARADIO, "instances", "full", "0.3553 \n 0.4336 \n 0.5538"),
        (NARADIO, "fused_instances", "full", "0.4062 \n 0.4708 \n 0.5887"),
        (NARADIO, "fused_instances", "window", "0.4022 \n 0.4622 \n 0.5778"),
        (NARADIO, "fused_instances", "window_no_evidence", "0.3530 \n 0.4135 \n 0.5278"),
    ):
        yield from _scores("HM3DSem", method, layer, columns, values, mode)


def _memory() -> Iterator[PaperRow]:
    sizes = {
        "HM3DSem 00824": (1243, 355, 623, 180),
        "HM3DSem 00829": (899, 268, 451, 137),
        "HM3DSem 00843": (1145, 254, 574, 130),
        "HM3DSem 00847": (1201, 546, 603, 276),
        "HM3DSem 00873": (1194, 311, 599, 158),
        "HM3DSem 00877": (1162, 323, 583, 164),
        "HM3DSem 00890": (1473, 231, 739, 118),
        "TartanGround Hospital": (5970, 354, 2994, 185),
        "Odin1 University": (5862, 1054, 2940, 534),
    }
    columns = tuple(product((NARADIO, CLIP_DINOISER), (("dense", "full"), ("all", "window"))))
    for scene, values in sizes.items():
        for (method, (layer, mode)), value in zip(columns, values, strict=True):
            yield PaperRow("memory", scene, method, layer, mode, None, "MiB", float(value))


def _frame_rates() -> Iterator[PaperRow]:
    rates = {
        ("RTX 4090", "no fusion"): (11.85, 11.24, 16.50, 15.48),
        ("RTX 4090", "window"): (11.00, 10.15, 15.88, 14.59),
        ("Jetson AGX Orin", "no fusion"): (3.54, 3.44, 3.23, 3.10),
        ("Jetson AGX Orin", "window"): (3.14, 2.94, 3.16, 3.00),
    }
    columns = tuple(product((NARADIO, CLIP_DINOISER), (REPLICA, SCANNET)))
    for (device, mode), values in rates.items():
        for (method, dataset), value in zip(columns, values, strict=True):
            yield PaperRow("frame rates", dataset, method, "all", mode, None, "Hz", value, device=device)


PAPER_ROWS: tuple[PaperRow, ...] = (
    *_instance_maps(),
    *_dense_maps(),
    *_instance_ablation(),
    *_dense_ablation(),
    *_lambda_sweep(),
    *_hm3dsem(),
    *_memory(),
    *_frame_rates(),
)
"""Every number of the paper's tables."""
