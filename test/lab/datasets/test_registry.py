"""Datasets by name, and their options."""

from __future__ import annotations

import pytest
from recorded_frames import noise_frames, write_sevenscenes

from fus3dmaps_core.errors import ConfigError, RecordingError
from fus3dmaps_lab.datasets.registry import names, open_dataset, open_labelled


@pytest.fixture
def sequence(tmp_path):
    write_sevenscenes(tmp_path / "seq-01", noise_frames(5, 64, 48), [0, 1, 2, 3, 4])
    return tmp_path / "seq-01"


@pytest.mark.parametrize("name", names())
def test_every_layout_names_a_folder_that_is_not_there(name, tmp_path):
    with pytest.raises(RecordingError, match="nowhere' is not a directory"):
        open_dataset(name, tmp_path / "nowhere")
    with pytest.raises(ConfigError, match="option 'colour' is unknown to"):
        open_dataset(name, tmp_path, colour="red")
    (tmp_path / "empty").mkdir()
    with pytest.raises(RecordingError, match="empty"):
        open_dataset(name, tmp_path, scene="empty", **({"camera": "1"} if name == "tum" else {}))


def test_options_may_be_text(sequence):
    dataset = open_dataset("sevenscenes", sequence.parent, scene="seq-01", stride="2")
    assert (dataset.name, dataset.scene, len(dataset), len(list(dataset))) == ("sevenscenes", "seq-01", 3, 3)
    for stride in ("0", "-1", "two", 1.5):
        with pytest.raises(ConfigError, match="'stride' must be"):
            open_dataset("sevenscenes", sequence, stride=stride)


def test_refusals_name_what_is_known(sequence):
    with pytest.raises(RecordingError, match=r"'kitti'.*scannet, sevenscenes"):
        open_dataset("kitti", sequence)
    with pytest.raises(RecordingError, match="no labels"):
        open_labelled("sevenscenes", sequence)
