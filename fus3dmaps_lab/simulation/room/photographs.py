"""Real photographs from the scikit-image wheel; none of them is downloaded.

According to scikit-image, the cat, the espresso and the man with the camera are CC0 (Stéfan van der Walt, Rachel Michetti,
Lav Varshney), the rocket (SpaceX) and the astronaut (NASA) in the public domain. The motorcycle is from the Middlebury
2014 stereo benchmark (Scharstein et al.), for which it names no licence.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core.errors import RecordingError

FILES = {
    "astronaut": "astronaut.png",
    "cameraman": "camera.png",
    "cat": "chelsea.png",
    "coffee": "coffee.png",
    "motorcycle": "motorcycle_left.png",
    "rocket": "rocket.jpg",
}

# Pixels cut away (top, bottom, left, right) from pictures with a small subject.
_TRIMS = {"rocket": (40, 0, 120, 120)}


def photograph(name: str) -> NDArray[np.uint8]:
    """Read one of the photographs of :data:`FILES`.

    Returns:
        (h, w, 3) uint8 RGB, upright.

    Raises:
        RecordingError: scikit-image is not installed, or its wheel has no such file.
    """
    spec = find_spec("skimage")
    if spec is None or spec.origin is None:
        raise RecordingError(
            "the furnished room needs the photographs of the package 'scikit-image', which is not installed"
        )
    path = Path(spec.origin).parent / "data" / FILES[name]
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise RecordingError(f"photograph '{path}' of the package 'scikit-image' is missing or unreadable")
    top, bottom, left, right = _TRIMS.get(name, (0, 0, 0, 0))
    height, width = image.shape[:2]
    rgb: NDArray[np.uint8] = cv2.cvtColor(image[top : height - bottom, left : width - right], cv2.COLOR_BGR2RGB)
    return rgb
