"""Tables hold every number, and CSV gives back exactly the same numbers."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fus3dmaps_lab.evaluation.records import CurvePoint, Record
from fus3dmaps_lab.evaluation.statistics import spread
from fus3dmaps_lab.evaluation.tables import (
    ALL_SCENES,
    Column,
    Table,
    comparison_table,
    curve_table,
    metrics_table,
    options_table,
    options_tests_table,
    points_table,
    records_table,
    scores_table,
    summary_table,
)

SCENE = "simulated building"
numbers = st.floats(allow_nan=False, allow_infinity=False)
words = st.text(st.characters(codec="utf-8", exclude_categories=("Cs",), exclude_characters="\r"), max_size=12)


def read_csv(text):
    return list(csv.reader(io.StringIO(text, newline=""), quoting=csv.QUOTE_NONNUMERIC))


def records_of(values, scene=SCENE):
    """Make mIoU records from ``values``: {(layer, mode): [value of seed 0, 1, ...]}."""
    return [Record(scene, s, *where, "mIoU", v) for where, vs in values.items() for s, v in enumerate(vs)]


@given(st.lists(st.tuples(words, numbers, st.integers(0, 10**6)), min_size=1, max_size=5))
def test_csv_gives_back_what_was_written(rows):
    table = Table((Column("text, with a comma"), Column('a "number"'), Column("count")), tuple(rows))
    heading, *lines = read_csv(table.csv())
    assert heading == ["text, with a comma", 'a "number"', "count"]
    assert [tuple(line) for line in lines] == rows


def test_a_number_that_is_text_stays_text():
    assert read_csv(Table((Column("scene"), Column("value")), (("0011", 0.5),)).csv())[1] == ["0011", 0.5]


def test_csv_has_spreads_in_full():
    values = [0.1, 0.2, 0.4]
    heading, line, empty = read_csv(Table((Column("mIoU"),), ((spread(values),), (spread([]),))).csv())
    assert heading == ["mIoU mean", "mIoU std", "mIoU min", "mIoU max", "mIoU n"]
    one = spread(values)
    assert line == [one.mean, one.std, 0.1, 0.4, 3]
    assert all(map(math.isnan, empty[:4]))
    assert empty[4] == 0


def test_markdown():
    table = Table(
        (Column("layer"), Column("mIoU"), Column("change", "+.2f"), Column("seed"), Column("p", ".2g")),
        (
            ("a|b", spread([0.1, 0.2]), spread([0.5, 0.25]), 3, 0.00123),
            ("c", spread([]), spread([-0.5]), 4, math.nan),
            ("d", spread([0.5, math.nan]), spread([0.0]), 5, 1.0),
        ),
    )
    assert table.markdown() == (
        "| layer | mIoU | change | seed | p |\n"
        "| --- | --: | --: | --: | --: |\n"
        "| a\\|b | 0.1500 ± 0.0707 | +0.38 ± 0.18 | 3 | 0.0012 |\n"
        "| c | – | -0.50 | 4 | – |\n"
        "| d | 0.5000 (n = 1) | +0.00 | 5 | 1 |\n"
    )


def test_a_row_of_the_wrong_length_is_a_mistake():
    with pytest.raises(ValueError, match="2 cells under 1 columns"):
        Table((Column("a"),), ((1, 2),))


@given(st.permutations(range(6)))
def test_records_come_back_from_csv_whatever_their_order(order):
    records = [
        Record(SCENE, 1, "fused_dense", "window", "mIoU", 0.25),
        Record(SCENE, 0, "dense", "full", "iou/bed", 1 / 3),
        Record("0011", 0, "instances", "window_no_evidence", "AP25", 0.1 + 0.2),
        Record(SCENE, 10, "dense", "full", "mIoU", 1e-300),
        Record(SCENE, 2, "dense", "full", "mIoU", 0.5),
        Record(SCENE, 0, "dense", "full", "mIoU", 0.125),
    ]
    lines = read_csv(records_table([records[i] for i in order]).csv())[1:]
    read = [Record(line[0], int(line[1]), *line[2:]) for line in lines]
    assert sorted(read, key=str) == sorted(records, key=str)
    assert lines == read_csv(records_table(records).csv())[1:]


def test_points_come_back_from_csv():
    points = [
        CurvePoint("lambda", "R^D / R^I = 5", 0, 0.1, "mIoU", 0.3),
        CurvePoint("memory", "dense map", 2, 7.5, "bytes", 9e9),
    ]
    read = [CurvePoint(*line[:2], int(line[2]), *line[3:]) for line in read_csv(points_table(points).csv())[1:]]
    assert read == points


def test_scores_show_every_seed_and_what_is_missing():
    records = records_of({("dense", "full"): [0.1, 0.2], ("instances", "window"): [0.3]})
    records.append(Record(SCENE, 1, "dense", "full", "AP25", 0.9))
    records.append(Record(SCENE, 1, "dense", "full", "iou/bed", 0.9))
    table = scores_table(records)
    assert [column.name for column in table.columns] == ["scene", "seed", "layer", "mode", "mIoU", "AP25"]
    assert [row[:5] for row in table.rows] == [
        (SCENE, 0, "dense", "full", 0.1),
        (SCENE, 0, "instances", "window", 0.3),
        (SCENE, 1, "dense", "full", 0.2),
    ]
    assert math.isnan(table.rows[0][5])
    assert table.rows[2][5] == 0.9


def test_summary_is_over_seeds_then_over_scenes():
    records = records_of({("dense", "full"): [0.1, 0.3]}) + records_of({("dense", "full"): [0.8]}, "simulated flat")
    assert summary_table(records).rows == (
        (SCENE, "dense", "full", spread([0.1, 0.3])),
        ("simulated flat", "dense", "full", spread([0.8])),
        (ALL_SCENES, "dense", "full", spread([0.1, 0.3, 0.8])),
    )
    assert [row[0] for row in summary_table(records[:2]).rows] == [SCENE]


def test_metrics_table_has_a_column_for_every_layer_and_mode():
    records = records_of({("instances", "window"): [0.1, 0.3], ("dense", "full"): [0.5]})
    table = metrics_table(records, ["mIoU", "AP25"])
    assert [column.name for column in table.columns] == ["metric", "dense, full", "instances, window"]
    assert table.rows[0] == ("mIoU", spread([0.5]), spread([0.1, 0.3]))
    assert [cell.count for cell in table.rows[1][1:]] == [0, 0]


def test_paired_tests_and_refusals():
    records = records_of(
        {
            ("instances", "full"): [0.40, 0.41, 0.42, 0.43, 0.44],
            ("fused_instances", "full"): [0.45, 0.47, 0.45, 0.50, 0.49],
            ("fused_instances", "window"): [0.44, 0.46, 0.45, 0.49, 0.48],
            ("dense", "full"): [0.4, 0.4],
            ("fused_dense", "full"): [0.5],
        }
    )
    table, refusals = comparison_table(records, ["mIoU", "accuracy"])
    instances, window = table.rows
    assert instances[:2] == ("fused against unfused instances", "mIoU")
    assert instances[4].mean == pytest.approx(0.052)
    assert instances[6] == "5 of 5"
    assert instances[8] == instances[9] == pytest.approx(0.0625)
    assert window[0] == "sliding window against the whole dense layer"
    assert window[5] == pytest.approx(100 * 2.32 / 2.36)
    assert window[6] == "0 of 5"
    assert refusals == [
        "fused against unfused dense layer: mIoU of fused_dense, full lacks simulated building seed 1, "
        "which mIoU of dense, full has"
    ]


def test_options_are_compared_with_the_first():
    levels = {"IoU 0.2": [0.40, 0.41, 0.42], "visible": [0.45, 0.40, 0.44], "merging": [0.5, 0.5]}
    points = [CurvePoint("association", way, s, 0.0, "mIoU", v) for way, vs in levels.items() for s, v in enumerate(vs)]
    unfused = [replace(point, curve=f"{point.curve}, unfused", value=1 - point.value) for point in points[:6]]
    table, refusals = options_tests_table([*points, *unfused], ["mIoU", "AP25"])
    row, mirrored = table.rows
    assert row[:3] == ("visible", "IoU 0.2", "mIoU")
    assert row[5].mean == pytest.approx(0.02)
    assert row[7] == "2 of 3"
    assert refusals == ["mIoU of merging lacks x = 0, seed 2, which mIoU of IoU 0.2 has"]
    assert mirrored[:3] == ("visible, unfused", "IoU 0.2, unfused", "mIoU")
    assert mirrored[5].mean == pytest.approx(-0.02)
    assert options_tests_table([], ["mIoU"])[0].rows == ()
    summary = options_table(points)
    assert [column.name for column in summary.columns] == ["metric", *levels]
    assert summary.rows == (("mIoU", *map(spread, levels.values())),)


def test_curves_keep_their_order_and_average_over_seeds():
    points = [
        CurvePoint("association", way, seed, 0.0, metric, value + seed)
        for way, value in (("visible IoU 0.2", 3.0), ("IoU 0.2", 1.0))
        for seed in (0, 1)
        for metric in ("instances", "mIoU")
    ]
    table = curve_table(points, "x")
    assert [column.name for column in table.columns] == ["curve", "x", "mIoU", "instances"]
    assert table.rows == (
        ("visible IoU 0.2", 0.0, spread([3.0, 4.0]), spread([3.0, 4.0])),
        ("IoU 0.2", 0.0, spread([1.0, 2.0]), spread([1.0, 2.0])),
    )
    assert "| 4 ± 1 |" in table.markdown()  # A count of instances has no decimals.
