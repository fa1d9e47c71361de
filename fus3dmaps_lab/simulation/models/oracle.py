"""What the simulated models know: the labels of the frame that the camera looks at now."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import EncoderError
from fus3dmaps_lab.simulation.truth import LabelledFrame


class Oracle:
    """Holds the labelled frame that is being processed, for the simulated encoders and the simulated segmenter.

    This is a simulation: whoever asks sees the truth. Models are handed nothing but a colour image; whoever feeds frames
    tells the oracle first which one comes, and simulated models look its labels up here. Not for several threads at once.
    """

    def __init__(self) -> None:
        """Look at nothing yet."""
        self._current: LabelledFrame | None = None

    def look(self, labelled: LabelledFrame) -> None:
        """Make a frame the current one; it stays so until the next."""
        self._current = labelled

    @property
    def current(self) -> LabelledFrame:
        """The frame looked at.

        Raises:
            EncoderError: None has been looked at.
        """
        if self._current is None:
            raise EncoderError("the simulation's oracle has looked at no frame: call look() before encoding or segmenting")
        return self._current

    def parts_of(self, rgb: NDArray[np.uint8]) -> NDArray[np.int32]:
        """(H, W) int32 part seen by each pixel of an (H, W, 3) colour image, which must be the current frame's.

        As the pipeline resizes depth, labels are resized by nearest neighbour.

        Raises:
            EncoderError: No frame has been looked at, or the image has its size but is another.
        """
        return self._resized(rgb, self.current.parts)

    def depth_of(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """(H, W) float32 true depth of each pixel of an (H, W, 3) colour image, metres, 0 where there is nothing.

        Raises:
            EncoderError: As :meth:`parts_of`.
        """
        return self._resized(rgb, self.current.true_depth_m)

    def _resized(self, rgb: NDArray[np.uint8], image: NDArray[Any]) -> NDArray[Any]:
        looked_at = self.current.frame.rgb
        # A resized image cannot be told apart cheaply; one of the same size can, and mixed-up labels would go unnoticed.
        if rgb is not looked_at and rgb.shape == looked_at.shape and not np.array_equal(rgb, looked_at):
            stamp_ns = self.current.frame.stamp_ns
            raise EncoderError(f"the image is not that of the frame which the simulation's oracle looks at ({stamp_ns} ns)")
        height, width = rgb.shape[:2]
        if image.shape == (height, width):
            return image
        return np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_NEAREST_EXACT), image.dtype)
