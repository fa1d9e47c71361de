"""The map of the method in dictionaries: dense layer, instance layer, fusion, sliding window."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from reference.vectors import Key, Vector, center_of, cosine, unit, voxel_of


@dataclass
class Instance:
    """Embedding f_id and weight w_id, and what fusion last stored for it."""

    embedding: Vector
    weight: int
    fused_embedding: Vector | None = None
    evidence: float = 0.0


@dataclass(frozen=True)
class Fusion:
    """What one fusion did; ``recomputed`` only where it has one answer."""

    updated: int
    recomputed: int | None


@dataclass
class ReferenceMap:
    """Every quantity of the method under its own name, updated one point, voxel or instance at a time.

    ``seen`` counts the branches that were taken, so that a test can tell whether its sequence reached them.
    ``dense_roundings`` is how many roundings a dense mean of low precision may be off by: each write adds at most one, and
    those before it weigh as much as the mean that they are in. ``most_dense_roundings`` is the largest there ever was.
    ``slot_order`` is the order of slots of the map that this is compared with, which decides between voxels of equal weight.
    """

    voxel_size_m: float
    max_hypotheses: int
    iou_threshold: float
    variance_ratio: float
    window_radius_m: float = 0.0
    keep_most_evidence: bool = True
    association: str = "iou"
    merge_overlap: float = 0.0
    merge_cosine: float = 0.8
    next_id: int = 0
    voxels: set[Key] = field(default_factory=set)
    color: dict[Key, Vector] = field(default_factory=dict)
    dense_weight: dict[Key, float] = field(default_factory=dict)
    dense_mean: dict[Key, Vector] = field(default_factory=dict)
    dense_roundings: dict[Key, float] = field(default_factory=dict)
    most_dense_roundings: float = 0.0
    hypotheses: dict[Key, dict[int, int]] = field(default_factory=dict)
    instances: dict[int, Instance] = field(default_factory=dict)
    dropped_keys: set[Key] = field(default_factory=set)
    slot_order: list[Key] = field(default_factory=list)
    seen: Counter[str] = field(default_factory=Counter)

    # ---- dense layer

    def integrate_dense(self, points_m, patches, embeddings, weights, colors) -> None:
        """One keyframe's points; ``patches`` says whose embedding and weight each point carries."""
        arrived_weight: dict[Key, float] = {}
        arrived_sum: dict[Key, Vector] = {}
        arrived_colors: dict[Key, list[Vector]] = {}
        for point, patch, color in zip(points_m, patches, colors, strict=True):
            key = voxel_of(point, self.voxel_size_m)
            self.voxels.add(key)
            arrived_colors.setdefault(key, []).append(np.asarray(color, dtype=np.float64))
            weight = float(weights[patch])
            arrived_weight[key] = arrived_weight.get(key, 0.0) + weight
            arrived_sum[key] = arrived_sum.get(key, 0.0) + weight * unit(embeddings[patch])
        for key, colors_of_voxel in arrived_colors.items():
            self.color[key] = sum(colors_of_voxel) / len(colors_of_voxel)
        for key, weight in arrived_weight.items():
            if weight == 0.0:
                self.seen["dense_weightless"] += 1
                continue
            self.seen["dense_new" if key not in self.dense_weight else "dense_again"] += 1
            if key in self.dropped_keys and key not in self.dense_weight:
                self.seen["dense_revisit"] += 1
            old = self.dense_weight.get(key, 0.0)
            mean = self.dense_mean.get(key, np.zeros_like(arrived_sum[key]))
            self.dense_mean[key] = (old * mean + arrived_sum[key]) / (old + weight)
            self.dense_weight[key] = old + weight
            self.dense_roundings[key] = old / (old + weight) * self.dense_roundings.get(key, 0.0) + 1.0
            self.most_dense_roundings = max(self.most_dense_roundings, self.dense_roundings[key])

    # ---- instance layer

    def voxels_of(self, instance_id: int) -> set[Key]:
        """V_id: the voxels that hold the instance as a hypothesis."""
        return {key for key, counts in self.hypotheses.items() if instance_id in counts}

    def top_of(self, key: Key) -> int | None:
        """The hypothesis of a voxel with the highest count; of equal ones the lowest id."""
        counts = self.hypotheses.get(key, {})
        return min(counts, key=lambda each: (-counts[each], each)) if counts else None

    def integrate_proposals(self, points_m, proposals, embeddings, visible_points_m=None) -> list[int]:
        """One keyframe's proposals in row order; the id each was given, -1 for one without points."""
        ids = []
        hit = {voxel_of(point, self.voxel_size_m) for point in points_m}
        seen = () if visible_points_m is None else visible_points_m
        visible = hit | {voxel_of(point, self.voxel_size_m) for point in seen}
        for m, embedding in enumerate(embeddings):
            hits: Counter[Key] = Counter()
            for point, proposal in zip(points_m, proposals, strict=True):
                if proposal == m:
                    hits[voxel_of(point, self.voxel_size_m)] += 1
            if not hits:
                self.seen["proposal_without_point"] += 1
                ids.append(-1)
                continue
            ids.append(self._integrate_proposal(hits, unit(embedding), visible))
        if self.merge_overlap > 0:
            while pairs := self._overlapping_pairs(hit):
                gone: set[int] = set()
                grown: set[int] = set()
                for a, b in pairs:
                    if not gone & {a, b} and b not in grown:
                        gone.add(b)
                        self.seen["merge_of_several"] += a in grown
                        grown.add(a)
                        self._merge(a, b)
                        ids = [a if each == b else each for each in ids]
                self.seen["merge_pass"] += 1
        return ids

    def _overlapping_pairs(self, keys: set[Key]) -> list[tuple[int, int]]:
        """Pairs a < b of instances that meet in one of the voxels and are to become one, in order."""
        meeting = {
            (a, b) for key in keys for a in self.hypotheses.get(key, {}) for b in self.hypotheses.get(key, {}) if a < b
        }
        found = []
        for a, b in sorted(meeting):
            of_a, of_b = self.voxels_of(a), self.voxels_of(b)
            if len(of_a & of_b) / min(len(of_a), len(of_b)) < self.merge_overlap:
                self.seen["merge_overlap_too_small"] += 1
            elif cosine(self.instances[a].embedding, self.instances[b].embedding) < self.merge_cosine:
                self.seen["merge_unlike"] += 1
            else:
                found.append((a, b))
        return found

    def _merge(self, a: int, b: int) -> None:
        """Let a take in b."""
        one, other = self.instances[a], self.instances.pop(b)
        total = one.weight + other.weight
        one.embedding = (one.weight * one.embedding + other.weight * other.embedding) / total
        one.weight = total
        if other.evidence > one.evidence:
            self.seen["merge_of_stored"] += 1
            one.fused_embedding, one.evidence = other.fused_embedding, other.evidence
        for counts in self.hypotheses.values():
            if b in counts:
                self.seen["merge_shared_voxel" if a in counts else "merge_renamed_voxel"] += 1
                counts[a] = counts.get(a, 0) + counts.pop(b)
        self.seen["instance_merged"] += 1

    def _integrate_proposal(self, hits: Counter[Key], embedding: Vector, visible: set[Key]) -> int:
        points = sum(hits.values())
        instance_id = self._associate(set(hits), visible)
        if instance_id is None:
            self.seen["instance_new"] += 1
            instance_id = self.next_id
            self.next_id += 1
            self.instances[instance_id] = Instance(embedding, points)
        else:
            self.seen["instance_match"] += 1
            instance = self.instances[instance_id]
            total = instance.weight + points
            instance.embedding = (instance.weight * instance.embedding + points * embedding) / total
            instance.weight = total
        for key in sorted(hits):
            self.voxels.add(key)
            counts = self.hypotheses.setdefault(key, {})
            if instance_id not in counts and len(counts) == self.max_hypotheses:
                self.seen["hypothesis_pruned"] += 1
                lowest = min(counts.values())
                if sum(count == lowest for count in counts.values()) > 1:
                    self.seen["hypothesis_pruned_tie"] += 1
                del counts[min(other for other, count in counts.items() if count == lowest)]
            counts[instance_id] = counts.get(instance_id, 0) + hits[key]
        self._delete_instances_without_voxels("instance_deleted")
        return instance_id

    def _delete_instances_without_voxels(self, branch: str) -> None:
        for other in [each for each in self.instances if not self.voxels_of(each)]:
            self.seen[branch] += 1
            del self.instances[other]

    def _associate(self, voxels: set[Key], visible: set[Key]) -> int | None:
        overlap: dict[int, float] = {}
        for instance_id in sorted({each for key in voxels for each in self.hypotheses.get(key, {})}):
            members = self.voxels_of(instance_id)
            counted = members & visible if self.association == "visible_iou" else members
            if len(counted) < len(members):
                self.seen["match_of_visible"] += 1
            overlap[instance_id] = len(voxels & members) / len(voxels | counted)
        if not overlap:
            return None
        best = max(overlap.values())
        winners = [each for each, value in overlap.items() if value == best]
        if len(winners) > 1:
            self.seen["match_tie"] += 1
        if not best > self.iou_threshold:
            self.seen["overlap_too_small"] += 1
            return None
        return min(winners)

    # ---- cross-layer fusion

    def fused_instance(self, instance_id: int) -> tuple[Vector, float]:
        """f_fused,id and e_id from the map as it is."""
        embedding = self.instances[instance_id].embedding
        total, evidence = np.zeros_like(embedding), 0.0
        for key in sorted(self.voxels_of(instance_id)):
            weight = self.dense_weight.get(key, 0.0)
            support = self.variance_ratio * self.hypotheses[key][instance_id]
            rho = weight + support
            f_voxel = embedding if weight == 0.0 else (weight * self.dense_mean[key] + support * embedding) / rho
            total = total + rho * f_voxel
            evidence += rho
        return total / evidence, evidence

    def fused_dense(self, key: Key) -> Vector | None:
        """Fused embedding of a voxel; None where neither layer knows anything."""
        top = self.top_of(key)
        if top is None:
            return self.dense_mean.get(key)
        if key not in self.dense_weight:
            return self.instances[top].embedding
        weight, support = self.dense_weight[key], self.variance_ratio * self.hypotheses[key][top]
        return (weight * self.dense_mean[key] + support * self.instances[top].embedding) / (weight + support)

    def fuse(self, full: bool = False) -> Fusion:
        """Store fusion of every instance; with a window that keeps the most evidence only where it grew."""
        updated = 0
        for instance_id, instance in self.instances.items():
            fused, evidence = self.fused_instance(instance_id)
            if self.window_radius_m > 0 and self.keep_most_evidence and not evidence > instance.evidence:
                self.seen["fusion_kept"] += 1
                continue
            self.seen["fusion_replaced"] += 1
            self.seen["fusion_replaced_by_less"] += evidence < instance.evidence
            instance.fused_embedding, instance.evidence = fused, evidence
            updated += 1
        return Fusion(updated, len(self.instances) if full else None)

    def query_embedding(self, instance_id: int) -> Vector:
        """What layer fused_instances answers with: fresh without a window, what was stored with one."""
        instance = self.instances[instance_id]
        if self.window_radius_m == 0:
            return self.fused_instance(instance_id)[0]
        return instance.embedding if instance.fused_embedding is None else instance.fused_embedding

    # ---- sliding window

    def prune_window(self, center_m: Vector) -> int:
        """Forget the dense layer farther than the radius from the camera; returns how many voxels lost it."""
        if self.window_radius_m == 0:
            return 0
        far = [
            key for key in self.dense_weight if math.dist(center_of(key, self.voxel_size_m), center_m) > self.window_radius_m
        ]
        self._drop_dense(far)
        self.seen["window_dropped"] += len(far)
        return len(far)

    def _drop_dense(self, keys: list[Key]) -> None:
        for key in keys:
            del self.dense_weight[key], self.dense_mean[key], self.dense_roundings[key]
            self.dropped_keys.add(key)

    # ---- want of memory

    def set_window_radius(self, radius_m: float) -> None:
        """The radius of later prunings."""
        self.window_radius_m = radius_m

    def drop_least_observed(self, count: int) -> int:
        """Forget the dense layer of the voxels of least weight, of equal ones those of the lowest slot."""
        slot = {key: number for number, key in enumerate(self.slot_order)}
        by_weight = sorted(self.dense_weight, key=lambda key: (self.dense_weight[key], slot[key]))
        gone, kept = by_weight[:count], by_weight[count:]
        self.seen["least_observed_dropped"] += len(gone)
        if gone and kept and self.dense_weight[gone[-1]] == self.dense_weight[kept[0]]:
            self.seen["least_observed_tie"] += 1
        self._drop_dense(gone)
        return len(gone)

    def release_unused(self) -> None:
        """Nothing here is kept for later."""

    # ---- removal

    def remove_voxels(self, points_m) -> int:
        """Forget the voxels that hold the points; instances left without one die. Returns how many there were."""
        gone = {voxel_of(point, self.voxel_size_m) for point in points_m} & self.voxels
        for key in gone:
            self.voxels.remove(key)
            self.seen["removed_dense"] += key in self.dense_weight
            self.seen["removed_hypotheses"] += bool(self.hypotheses.get(key))
            for known in (self.color, self.dense_weight, self.dense_mean, self.dense_roundings, self.hypotheses):
                known.pop(key, None)
            self.dropped_keys.discard(key)
        self._delete_instances_without_voxels("instance_removed")
        return len(gone)
