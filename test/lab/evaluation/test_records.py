"""Records survive their file; what is not a list of records is refused by file and entry."""

from __future__ import annotations

import json
import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_core.errors import StorageError
from fus3dmaps_lab.evaluation.records import LAYERS, MODES, Record, read_records, write_records

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


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("[", "is not JSON"),
        ("[" * 100_000, "is not JSON"),
        ("{}", "must hold a list"),
        ([1], "record 0: must have the keys scene, seed"),
        ([GOOD, {**GOOD, "spread": 1}], "record 1: must have the keys"),
        ([{key: value for key, value in GOOD.items() if key != "mode"}], "record 0: must have the keys"),
        ([GOOD | {"layer": "sparse"}], "record 0: layer must be one of dense"),
        ([GOOD | {"mode": "half"}], "record 0: mode must be one of full"),
        ([GOOD | {"mode": ["full"]}], "record 0: mode must be a text"),
        ([GOOD | {"scene": None}], "record 0: scene must be a text"),
        ([GOOD | {"metric": 5}], "record 0: metric must be a text"),
        ([GOOD | {"seed": 1.5}], "record 0: seed must be a whole number"),
        ([GOOD | {"seed": True}], "record 0: seed must be a whole number"),
        ([GOOD | {"value": "0.5"}], "record 0: value must be a number or null"),
        ([GOOD | {"value": False}], "record 0: value must be a number or null"),
        ([GOOD | {"value": math.nan}], "record 0: value must be a number or null"),
        ([GOOD | {"value": math.inf}], "record 0: value must be a number or null"),
    ],
)
def test_what_is_not_records_is_refused_by_file_and_entry(tmp_path, content, named):
    path = tmp_path / "results.json"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(StorageError, match=f"{re.escape(str(path))}: {re.escape(named)}"):
        read_records(path)


def test_missing_and_unwritable_files_are_named(tmp_path):
    with pytest.raises(StorageError, match=r"nothing\.json: cannot be read"):
        read_records(tmp_path / "nothing.json")
    (tmp_path / "file").touch()
    with pytest.raises(StorageError, match=r"results\.json: cannot be written"):
        write_records(tmp_path / "file" / "results.json", [])
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(StorageError, match=r"binary\.json: is not JSON"):
        read_records(tmp_path / "binary.json")
