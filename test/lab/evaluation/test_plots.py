"""Plots show the data that they were given, name it, and are the same every time."""

from __future__ import annotations

import math

import cv2
import matplotlib as mpl
import numpy as np
import pytest
from lab.evaluation.made_up_results import (
    CLASSES,
    LAMBDAS,
    association_points,
    lambda_points,
    made_up_records,
    memory_points,
    window_points,
)

from fus3dmaps_lab.evaluation import plots
from fus3dmaps_lab.evaluation.effects import FUSED_DENSE, FUSED_INSTANCES
from fus3dmaps_lab.evaluation.records import CurvePoint, Record

GIB = 2.0**30

DRAWN = {
    "classes": lambda: plots.class_plot(made_up_records(), FUSED_INSTANCES),
    "lambda": lambda: plots.lambda_plot(lambda_points()),
    "memory": lambda: plots.memory_plot(memory_points()),
    "window": lambda: plots.window_plot(window_points()),
    "association": lambda: plots.association_plot(association_points()),
}


def line(axes, label):
    (found,) = [one for one in axes.get_lines() if one.get_label() == label]
    return np.asarray(found.get_xdata(), float), np.asarray(found.get_ydata(), float)


def title(figure):
    (axes, *_) = figure.axes
    return f"{' '.join(text.get_text() for text in figure.texts)} {axes.get_title()} {axes.get_title(loc='left')}"


@pytest.mark.parametrize("name", DRAWN)
def test_pictures_are_not_blank_and_always_the_same(name):
    first, second = (plots.image_bytes(DRAWN[name]()) for _ in range(2))
    assert first == second
    image = cv2.imdecode(np.frombuffer(first, np.uint8), cv2.IMREAD_COLOR)
    assert min(image.shape[:2]) > 200
    assert 0.01 < (image.min(axis=2) < 200).mean() < 0.6
    assert (image[0] == 255).all()  # Nothing is cut off at the edges.
    assert (image[-1] == 255).all()


@pytest.mark.parametrize("name", DRAWN)
def test_svg_is_the_same_every_time(name):
    first, second = (plots.image_bytes(DRAWN[name](), "svg") for _ in range(2))
    assert first == second
    assert first.startswith(b"<?xml")
    assert b"<dc:date>" not in first


@pytest.mark.parametrize("name", DRAWN)
def test_simulations_say_so_and_axes_have_names(name):
    figure = DRAWN[name]()
    assert "simulation" in title(figure)
    assert all(axes.get_xlabel() for axes in figure.axes)


@pytest.mark.parametrize("name", DRAWN)
def test_settings_of_the_caller_are_ignored_and_left_alone(name):
    plain = plots.image_bytes(DRAWN[name]())
    with mpl.rc_context({"lines.linewidth": 9.0, "font.size": 30.0, "axes.facecolor": "black"}):
        before = dict(mpl.rcParams)
        assert plots.image_bytes(DRAWN[name]()) == plain
        assert dict(mpl.rcParams) == before


def test_recorded_scenes_are_no_simulation():
    figure = plots.class_plot(made_up_records("room0", seeds=(0,)), FUSED_INSTANCES)
    assert figure is not None
    assert "simulation" not in title(figure)


def test_classes_are_in_order_of_what_fusion_changes():
    changes = {"bed": 0.2, "cup": -0.1, "sofa": 0.1}
    records = [
        Record("simulated flat", seed, layer, "full", f"iou/{name}", 0.5 + seed * 0.02 + change * (layer == "fused_dense"))
        for name, change in changes.items()
        for layer in ("dense", "fused_dense")
        for seed in (0, 1, 2)
    ]
    figure = plots.class_plot(records, FUSED_DENSE)
    assert figure is not None
    (axes,) = figure.axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["cup", "sofa", "bed"]
    unfused, fused = (np.asarray(container.lines[0].get_xdata(), float) for container in axes.containers)
    np.testing.assert_allclose(unfused, [0.52, 0.52, 0.52])
    np.testing.assert_allclose(fused, [0.42, 0.62, 0.72])
    (bars,) = axes.containers[0].lines[2]
    np.testing.assert_allclose([np.ptp(segment[:, 0]) for segment in bars.get_segments()], 2 * 0.02)
    assert "greater for 2 of 3 classes" in title(figure)


def test_a_class_is_drawn_from_the_seeds_where_both_are_defined():
    values = {("dense", 0): 0.2, ("fused_dense", 0): 0.3, ("dense", 1): 0.9, ("fused_dense", 1): math.nan}
    records = [Record("simulated flat", seed, layer, "full", "iou/bed", v) for (layer, seed), v in values.items()]
    figure = plots.class_plot(records, FUSED_DENSE)
    assert figure is not None
    assert figure.axes[0].containers[0].lines[0].get_xdata() == pytest.approx([0.2])
    assert plots.class_plot(records[2:], FUSED_DENSE) is None


def test_lambda_has_a_panel_for_every_ratio_with_prediction_and_best():
    figure = plots.lambda_plot(lambda_points({5.0: 1.0}, ratios=(5.0, 0.2)))
    assert figure is not None
    assert [axes.get_title() for axes in figure.axes] == ["R$^D$ / R$^I$ = 0.2", "R$^D$ / R$^I$ = 5"]
    for axes, ratio, best in zip(figure.axes, (0.2, 5.0), (0.2, 1.0), strict=True):
        assert axes.get_xscale() == "log"
        x, y = line(axes, "mean ± std")
        np.testing.assert_allclose(x, LAMBDAS)
        np.testing.assert_allclose(y, 0.52 - 0.02 * np.log10(np.array(LAMBDAS) / best) ** 2)
        assert line(axes, "predicted: R$^D$ / R$^I$")[0].tolist() == [ratio, ratio]
        assert [value.tolist() for value in line(axes, "best lambda")] == [[best], [pytest.approx(0.52)]]
        assert len(axes.get_lines()) == 5 + 3  # Seeds, mean, prediction and best.
        (band,) = axes.collections
        low, high = band.get_datalim(axes.transData).intervaly
        std = np.std(0.01 * np.arange(5), ddof=1)
        assert (low, high) == (pytest.approx(y.min() - std), pytest.approx(y.max() + std))


def test_a_curve_of_another_name_has_no_prediction():
    figure = plots.lambda_plot([CurvePoint("lambda", "as given", 0, x, "mIoU", x) for x in (0.1, 1.0)])
    assert figure is not None
    assert [one.get_label() for one in figure.axes[0].get_lines()] == ["one seed", "mean ± std"]


def test_memory_is_in_gib_with_the_predicted_line():
    figure = plots.memory_plot(memory_points(slope=1.1))
    assert figure is not None
    (axes,) = figure.axes
    assert axes.get_ylabel() == "memory, GiB"
    assert axes.get_xlabel() == "mapped volume, m³"
    x, y = line(axes, "dense map")
    np.testing.assert_allclose(y, 1.1 * 2e7 * x / GIB)
    np.testing.assert_allclose(line(axes, "sliding window")[1], 0.11 * 2e7 * x / GIB)
    np.testing.assert_allclose(line(axes, "predicted by bytes per voxel")[1], 2e7 * x / GIB)
    assert len(axes.get_lines()) == 2 * 2 + 1
    small = plots.memory_plot([CurvePoint("memory", "dense map", 0, 1.0, "bytes", 2.0**21)])
    assert small is not None
    assert small.axes[0].get_ylabel() == "memory, MiB"
    assert line(small.axes[0], "dense map")[1].tolist() == [2.0]


def test_radius_zero_is_a_level_line():
    figure = plots.window_plot(window_points())
    assert figure is not None
    (axes,) = figure.axes
    x, y = line(axes, "fused instances")
    assert x.tolist() == [1.0, 2.0, 4.0, 6.0]
    np.testing.assert_allclose(y, 0.52 - 0.1 / x)
    np.testing.assert_allclose(line(axes, "fused instances, whole dense layer")[1], 0.52)
    np.testing.assert_allclose(line(axes, "instances, whole dense layer")[1], 0.42)
    assert axes.get_xlabel() == "radius of the window, m"
    assert axes.get_ylabel() == "mIoU"


def test_bars_of_association_are_in_the_given_order():
    figure = plots.association_plot(association_points())
    assert figure is not None
    assert [axes.get_xlabel() for axes in figure.axes] == ["mIoU", "AP25", "number of instances"]
    assert [label.get_text() for label in figure.axes[0].get_yticklabels()] == [
        "IoU 0.2",
        "visible IoU 0.2",
        "IoU 0.2 + merging",
    ]
    widths = [[bar.get_width() for bar in axes.patches] for axes in figure.axes]
    np.testing.assert_allclose(widths[0], [0.42, 0.47, 0.44])
    np.testing.assert_allclose(widths[2], [82, 92, 86])
    heights = [bar.get_y() for bar in figure.axes[0].patches]
    assert heights == sorted(heights, reverse=True)  # The first is on top.


def test_nothing_to_draw():
    assert plots.class_plot([], FUSED_INSTANCES) is None
    assert plots.lambda_plot([]) is None
    assert plots.memory_plot([]) is None
    assert plots.window_plot([]) is None
    assert plots.association_plot([CurvePoint("association", "a", 0, 0.0, "something", 1.0)]) is None


def test_classes_of_the_made_up_results_are_all_drawn():
    figure = DRAWN["classes"]()
    assert sorted(label.get_text() for label in figure.axes[0].get_yticklabels()) == sorted(CLASSES)
