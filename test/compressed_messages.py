"""Images as image_transport compresses them: JPEG, PNG, and depth as PNG or RVL under the header of ``compressedDepth``."""

from __future__ import annotations

import cv2
import numpy as np
from reference.depth_codes import transport


def jpeg(rgb: np.ndarray, quality: int = 95) -> tuple[str, bytes]:
    """Format and data of a colour image."""
    data = cv2.imencode(".jpg", rgb[:, :, ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return "rgb8; jpeg compressed bgr8", data.tobytes()


def png(rgb: np.ndarray) -> tuple[str, bytes]:
    return "rgb8; png compressed bgr8", cv2.imencode(".png", rgb[:, :, ::-1])[1].tobytes()


def depth_png(depth_mm: np.ndarray) -> tuple[str, bytes]:
    """Depth under the ``compressed`` transport."""
    return "16UC1; png compressed ", cv2.imencode(".png", depth_mm)[1].tobytes()


def compressed_depth_png(depth_mm: np.ndarray) -> tuple[str, bytes]:
    return "16UC1; compressedDepth png", transport(depth_mm, "png")


def compressed_depth_rvl(depth_mm: np.ndarray) -> tuple[str, bytes]:
    return "16UC1; compressedDepth rvl", transport(depth_mm, "rvl")
