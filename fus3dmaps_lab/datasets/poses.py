"""Conversion of the poses of datasets to poses of the optical frame (x right, y down, z forward)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fus3dmaps_core.errors import RecordingError

_UNIT_TOLERANCE = 0.01  # Files round to four digits or more. A larger difference from 1 means that this is no quaternion.

FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""T_opengl_optical, for a camera that looks along -z with y up, as in OpenGL and Habitat."""

FROM_FORWARD_RIGHT_DOWN = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""T_frd_optical, for a camera that looks along x with y right and z down, as in AirSim with its NED world."""


def pose_of_quaternion(values: NDArray[np.float64], where: str) -> NDArray[np.float64]:
    """Return the (4, 4) pose for ``tx ty tz qx qy qz qw``: metres, and a unit quaternion with its scalar last.

    Raises:
        RecordingError: A value is not finite, or the quaternion is not of unit length; ``where`` names file and line.
    """
    norm = float(np.linalg.norm(values[3:7]))
    if not np.all(np.isfinite(values)) or abs(norm - 1) > _UNIT_TOLERANCE:
        raise RecordingError(f"{where} is not a position and a unit quaternion: {list(values)}")
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat(values[3:7]).as_matrix()
    T[:3, 3] = values[:3]
    return T
