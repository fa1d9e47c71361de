"""The oracle returns the labels of the current frame at the requested size."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from lab.simulation.models.made_up_frames import labelled, painted

from fus3dmaps_core.config.schema import ImageConfig
from fus3dmaps_core.errors import EncoderError
from fus3dmaps_core.geometry.projection import resize_frame
from fus3dmaps_lab.simulation.models.oracle import Oracle


def test_before_the_first_frame_it_says_so():
    with pytest.raises(EncoderError, match="looked at no frame"):
        _ = Oracle().current


def test_labels_of_the_frame_itself():
    oracle, frame = Oracle(), labelled(painted(48, 64, [(2, 10, 10, 30, 30)]), depth_m=1.5)
    oracle.look(frame)
    assert oracle.current is frame
    np.testing.assert_array_equal(oracle.parts_of(frame.frame.rgb), frame.parts)
    np.testing.assert_array_equal(oracle.depth_of(frame.frame.rgb.copy()), frame.true_depth_m)


@pytest.mark.parametrize("size", [(128, 96), (32, 32), (50, 37)])
def test_labels_are_resized_as_depth_is(size: tuple[int, int]):
    rng = np.random.default_rng(0)
    parts = rng.integers(0, 70_000, (48, 64)).astype(np.int32)
    frame = labelled(parts, depth_m=(1.0 + parts / 2**15).astype(np.float32))
    oracle = Oracle()
    oracle.look(frame)
    working = resize_frame(frame.frame, ImageConfig(width=size[0], height=size[1]))
    np.testing.assert_array_equal(oracle.depth_of(working.rgb), working.depth_m)
    found = oracle.parts_of(working.rgb)
    assert found.dtype == np.int32
    np.testing.assert_array_equal((1.0 + found / 2**15).astype(np.float32), working.depth_m)
    assert found.shape == cv2.resize(frame.frame.rgb, size).shape[:2]


def test_the_image_of_another_frame_is_refused():
    oracle = Oracle()
    oracle.look(labelled(painted(48, 64, []), stamp_ns=7))
    with pytest.raises(EncoderError, match="7 ns"):
        oracle.parts_of(labelled(painted(48, 64, [(2, 10, 10, 30, 30)])).frame.rgb)
