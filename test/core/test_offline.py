"""Mapping whole recordings in process: what is counted, what a damaged recording leaves, and repeatability."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from stand_ins import ColorSegmenter, color_trio, wall_frame

from fus3dmaps_core.config.schema import Config
from fus3dmaps_core.errors import RecordingError
from fus3dmaps_core.offline import map_recording
from fus3dmaps_core.pipeline import Pipeline
from fus3dmaps_core.recordings.writer import RecordingWriter
from fus3dmaps_core.saved_maps.storage import load_map, save_map

START_NS = 1_700_000_000_000_000_000
POSITIONS_M = [0.0, 0.02, 0.1, 0.12, 0.2, 0.35]


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "wall.mcap"
    with RecordingWriter(path) as writer:
        for index, x_m in enumerate(POSITIONS_M):
            writer.write(wall_frame(START_NS + index * 100_000_000, x_m=x_m))
    return path


def make_pipeline() -> Pipeline:
    return Pipeline(Config(), color_trio(), ColorSegmenter())


def test_the_summary_counts_what_was_done(recording: Path):
    pipeline, progress = make_pipeline(), []
    summary = map_recording(recording, pipeline, lambda done, total: progress.append((done, total)))
    assert progress == [(done, 6) for done in range(1, 7)]
    counts, stages_s = summary.ledger.counts(), summary.ledger.stages_s()
    assert (counts.frames, counts.not_keyframes, counts.dense_keyframes, counts.instance_keyframes) == (6, 2, 4, 3)
    assert pipeline.stamp_ns == START_NS + 500_000_000
    # Grey wall, red and blue square in each instance keyframe; the wall touches the border all around and is left out.
    assert counts.proposals == 6
    assert {"decode", "patch_encoder", "dense_update", "segmentation", "crop_encoder", "instance_update"} <= set(stages_s)
    assert sum(stages_s.values()) <= summary.duration_s
    assert not summary.ledger.drops.counts()


def test_the_map_is_fused_at_the_end(recording: Path):
    pipeline = make_pipeline()
    map_recording(recording, pipeline)
    assert (pipeline.semantic_map.export_state()["fused_evidence"] > 0).all()


def test_two_runs_and_their_files_are_equal_bit_for_bit(recording: Path, tmp_path: Path):
    for name in ("a", "b"):
        pipeline = make_pipeline()
        map_recording(recording, pipeline)
        save_map(tmp_path / name, pipeline, saved_ns=1)
    files = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert files == sorted(path.name for path in (tmp_path / "b").iterdir())
    assert [name for name in files if (tmp_path / "a" / name).read_bytes() != (tmp_path / "b" / name).read_bytes()] == []
    loaded, info = load_map(tmp_path / "a")
    assert loaded.voxel_count == pipeline.semantic_map.voxel_count
    assert (info.encoder, info.stamp_ns) == ("stand_in", START_NS + 500_000_000)
    np.testing.assert_array_equal(info.camera_poses[:, 0, 3], [0.0, 0.1, 0.2, 0.35])


def test_a_truncated_recording_is_refused_and_what_it_held_is_mapped(recording: Path, tmp_path: Path):
    intact = recording.read_bytes()
    whole = make_pipeline()
    map_recording(recording, whole)
    truncated = tmp_path / "truncated.mcap"
    truncated.write_bytes(intact[: int(0.7 * len(intact))])
    pipeline = make_pipeline()
    with pytest.raises(RecordingError, match=r"truncated\.mcap"):
        map_recording(truncated, pipeline)
    assert pipeline.semantic_map.voxel_count <= whole.semantic_map.voxel_count


def test_a_recording_without_a_usable_frame_says_why(tmp_path: Path):
    path = tmp_path / "other_frame.mcap"
    config = Config.from_flat({"input.map_frame": "odom"})
    with RecordingWriter(path, config.input) as writer:
        writer.write(wall_frame(START_NS))
    with pytest.raises(RecordingError, match=r"other_frame\.mcap.*wrong_frame"):
        map_recording(path, make_pipeline())
