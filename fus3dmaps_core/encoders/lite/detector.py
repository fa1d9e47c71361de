"""SSD-MobileNet-v2 (COCO) through OpenCV: boxes of eighty kinds of things, the strongest evidence this trio has.

The crop encoder, the patch encoder and the segmenter look at the same frames, so they share one detector, which remembers
its last images by their bytes and runs the network once for each.
"""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.encoders.lite.packaged_files import DETECTOR_GRAPH, DETECTOR_LAYOUT

_INPUT_SIZE = 300
_MIN_SCORE = 0.1
_REMEMBERED_IMAGES = 4


@dataclass(frozen=True)
class Detections:
    """Detections of one image, highest score first; boxes of one thing may overlap.

    Attributes:
        labels: (n,) int64, COCO category ids (1 to 90, with gaps).
        scores: (n,) float32 in (0.1, 1].
        boxes: (n, 4) float32, x0, y0, x1, y1 in pixels, within the image.
    """

    labels: NDArray[np.int64]
    scores: NDArray[np.float32]
    boxes: NDArray[np.float32]

    def __len__(self) -> int:
        """Return the number of detections."""
        return len(self.labels)


class Detector:
    """The network and its last answers; safe to use from several threads."""

    def __init__(self) -> None:
        """Load the network.

        Raises:
            EncoderError: The weights' package is missing or altered.
        """
        self._network = cv2.dnn.readNetFromTensorflow(str(DETECTOR_GRAPH.locate()), str(DETECTOR_LAYOUT.locate()))
        self._answers: OrderedDict[bytes, Detections] = OrderedDict()
        self._lock = threading.Lock()

    def detect(self, rgb: NDArray[np.uint8]) -> Detections:
        """Detect things in an (H, W, 3) uint8 image."""
        key = hashlib.blake2b(np.ascontiguousarray(rgb).data, digest_size=16, salt=str(rgb.shape[:2]).encode()).digest()
        with self._lock:
            found = self._answers.get(key)
            if found is None:
                found = self._run(rgb)
                self._answers[key] = found
                if len(self._answers) > _REMEMBERED_IMAGES:
                    self._answers.popitem(last=False)
            return found

    def _run(self, rgb: NDArray[np.uint8]) -> Detections:
        self._network.setInput(cv2.dnn.blobFromImage(rgb, size=(_INPUT_SIZE, _INPUT_SIZE), swapRB=False))
        rows = self._network.forward().reshape(-1, 7)
        height, width = rgb.shape[:2]
        boxes = np.clip(rows[:, 3:], 0.0, 1.0) * np.array([width, height, width, height], np.float32)
        sides = boxes[:, 2:] - boxes[:, :2]
        # Boxes of less than a pixel bound nothing.
        rows_kept = np.flatnonzero((rows[:, 2] > _MIN_SCORE) & (sides >= 1.0).all(axis=1))
        rows_kept = rows_kept[np.argsort(-rows[rows_kept, 2], kind="stable")]
        return Detections(
            rows[rows_kept, 1].astype(np.int64), rows[rows_kept, 2].astype(np.float32), boxes[rows_kept].astype(np.float32)
        )


_load_lock = threading.Lock()


@lru_cache(maxsize=1)
def _load() -> Detector:
    return Detector()


def shared_detector() -> Detector:
    """Return the detector of this process, loaded on first use.

    Raises:
        EncoderError: The weights' package is missing or altered.
    """
    with _load_lock:
        return _load()
