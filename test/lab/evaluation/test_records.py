"""Records survive their file, which is plain JSON; what cannot be written is refused by file."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_core.errors import StorageError
from fus3dmaps_lab.evaluation.records import LAYERS, MODES, Record, write_records

texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
a_record = st.builds(
    Record,
    scene=texts,
    seed=st.integers(-(2**63), 2**63),
    layer=st.sampled_from(LAYERS),
    mode=st.sampled_from(MODES),
    metric=texts,
    value=st.floats(allow_nan=True, allow_infinity=False),
)
GOOD = {"scene": "room0", "seed": 3, "layer": "dense", "mode": "full", "metric": "mIoU", "value": 0.5}


def read_records(path: Path) -> list[Record]:
    entries = json.loads(path.read_text(encoding="utf-8"))
    return [Record(**(entry | {"value": math.nan if entry["value"] is None else entry["value"]})) for entry in entries]


def as_compared(records):
    return [(r.scene, r.seed, r.layer, r.mode, r.metric, "undefined" if math.isnan(r.value) else r.value) for r in records]


@given(st.lists(a_record, max_size=5))
def test_records_come_back_as_they_were(tmp_path_factory, records):
    path = tmp_path_factory.mktemp("records") / "new" / "results.json"
    write_records(path, records)
    assert as_compared(read_records(path)) == as_compared(records)
    assert [each.name for each in path.parent.iterdir()] == ["results.json"]


def test_the_file_is_plain_json_with_null_for_what_is_undefined(tmp_path):
    path = tmp_path / "results.json"
    write_records(path, [Record(**GOOD), Record(**(GOOD | {"metric": "iou/sofa", "value": math.nan}))])

    def refuse(constant):
        raise AssertionError(f"{constant} is not JSON")

    found = json.loads(path.read_text(), parse_constant=refuse)
    assert found == [GOOD, GOOD | {"metric": "iou/sofa", "value": None}]


def test_an_infinite_value_is_refused_and_the_file_stays(tmp_path):
    path = tmp_path / "results.json"
    write_records(path, [Record(**GOOD)])
    with pytest.raises(StorageError, match="mIoU of room0 is infinite"):
        write_records(path, [Record(**(GOOD | {"value": math.inf}))])
    assert read_records(path) == [Record(**GOOD)]


def test_an_unwritable_file_is_named(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match=r"results\.json: cannot be written"):
        write_records(tmp_path / "file" / "results.json", [])
