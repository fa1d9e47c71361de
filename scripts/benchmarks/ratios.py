"""Ratios between the figures of a run."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

from benchmarks.measurements import Measurement

_SETTING = ("d", "dtype")
_SAME_INPUT = ("map_voxels", "d", "points", "keyframes")


def ratios(measurements: Sequence[Measurement]) -> list[Measurement]:
    """Compare largest and smallest map, most and fewest instances, RayFronts and ours, and bandwidth and a plain copy's."""
    return [
        *_across(measurements, "dense_update", "map_voxels", ("points", "keyframes")),
        *_across(measurements, "instance_update", "instances", ("map_voxels", "masks")),
        *_peers(measurements),
        *_shares(measurements),
    ]


def _across(measurements: Iterable[Measurement], name: str, varied: str, fixed: tuple[str, ...]) -> Iterator[Measurement]:
    """Divide figures at the largest by those at the smallest value of a param, for each setting of the others."""
    groups: dict[tuple[Any, ...], list[Measurement]] = {}
    for measurement in _named(measurements, name):
        groups.setdefault(tuple(measurement.params[key] for key in (*_SETTING, *fixed)), []).append(measurement)
    for setting, group in groups.items():
        least, most = (pick(group, key=lambda entry: entry.params[varied]) for pick in (min, max))
        low, high = least.params[varied], most.params[varied]
        if low == high:
            continue
        where = ", ".join(f"{key} {value}" for key, value in zip((*_SETTING, *fixed), setting, strict=True))
        yield _ratio(f"{name}: {varied} {high:,} / {low:,} ({where})", most, least)


def _peers(measurements: Sequence[Measurement]) -> Iterator[Measurement]:
    for theirs in _named(measurements, "rayfronts_update"):
        for ours in _named(measurements, "dense_update"):
            if all(ours.params[key] == theirs.params[key] for key in _SAME_INPUT):
                mode = "windowed" if theirs.params["windowed"] else "full"
                voxels, d = theirs.params["map_voxels"], theirs.params["d"]
                yield _ratio(f"RayFronts {mode} / ours ({ours.params['dtype']}), {voxels:,} voxels, d {d}", theirs, ours)


def _shares(measurements: Sequence[Measurement]) -> Iterator[Measurement]:
    for copy in _named(measurements, "copy_bandwidth"):
        for name in ("full_fusion_bandwidth", "text_query_bandwidth"):
            for measurement in _named(measurements, name):
                params = measurement.params
                layer = f" {params['layer']}" if "layer" in params else ""
                where = f"{params['map_voxels']:,} voxels, d {params['d']}, {params['dtype']}"
                yield _ratio(f"{name}{layer} / copy_bandwidth ({where})", measurement, copy)


def _named(measurements: Iterable[Measurement], name: str) -> Iterator[Measurement]:
    return (measurement for measurement in measurements if measurement.name == name)


def _ratio(of: str, above: Measurement, below: Measurement) -> Measurement:
    params = {"of": of, "above": dict(above.params), "below": dict(below.params)}
    return Measurement("ratio", params, above.value / below.value, "1")
