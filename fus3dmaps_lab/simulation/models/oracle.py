"""Access of the simulated models to the ground truth of the current frame."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import EncoderError
from fus3dmaps_lab.simulation.truth import LabelledFrame


class Oracle:
    """The labelled frame that is being processed, for the simulated encoders and the simulated segmenter.

    The pipeline hands models only a colour image. So the caller that feeds frames first tells the oracle which frame comes,
    and the simulated models look up its ground truth here. Not thread-safe.
    """

    def __init__(self) -> None:
        """Start without a frame."""
        self._current: LabelledFrame | None = None

    def look(self, labelled: LabelledFrame) -> None:
        """Set the current frame."""
        self._current = labelled

    @property
    def current(self) -> LabelledFrame:
        """The current frame.

        Raises:
            EncoderError: No frame has been set.
        """
        if self._current is None:
            raise EncoderError("the simulation's oracle has looked at no frame: call look() before encoding or segmenting")
        return self._current

    def parts_of(self, rgb: NDArray[np.uint8]) -> NDArray[np.int32]:
        """Return the (H, W) int32 part at each pixel of an (H, W, 3) colour image, which must be of the current frame.

        Labels are resized by nearest neighbour, as the pipeline does with depth.

        Raises:
            EncoderError: No frame has been looked at, or the image has its size but is another.
        """
        return self._resized(rgb, self.current.parts)

    def depth_of(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the (H, W) float32 true depth of an (H, W, 3) colour image, metres, 0 where there is nothing.

        Raises:
            EncoderError: As :meth:`parts_of`.
        """
        return self._resized(rgb, self.current.true_depth_m)

    def _resized(self, rgb: NDArray[np.uint8], image: NDArray[Any]) -> NDArray[Any]:
        looked_at = self.current.frame.rgb
        # Only an image of the original size can be compared cheaply. Labels of another frame would go unnoticed.
        if rgb is not looked_at and rgb.shape == looked_at.shape and not np.array_equal(rgb, looked_at):
            stamp_ns = self.current.frame.stamp_ns
            raise EncoderError(f"the image is not that of the frame which the simulation's oracle looks at ({stamp_ns} ns)")
        height, width = rgb.shape[:2]
        if image.shape == (height, width):
            return image
        return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_NEAREST_EXACT), image.dtype)
