"""A pairer that tests feed by what a message is, not by its topic."""

from __future__ import annotations

from typing import Any

from fus3dmaps_core.sources.pairing import FramePairer


class FedPairer(FramePairer):
    """Hands each message to the stream that its topic would hand it to; says how many messages it keeps."""

    @property
    def waiting(self) -> int:
        images = sum(len(camera._rgb) + len(camera._depth) for camera in self._cameras)
        return images + len(self._buffered._buffer) + len(self._held)

    def add_rgb(self, message: Any, camera: int = 0) -> None:
        self._add("input.rgb_topic", message, camera)

    def add_depth(self, message: Any, camera: int = 0) -> None:
        self._add("input.depth_topic", message, camera)

    def add_camera_info(self, message: Any, camera: int = 0) -> None:
        self._add("input.camera_info_topic", message, camera)

    def add_depth_camera_info(self, message: Any, camera: int = 0) -> None:
        self._add("input.depth_camera_info_topic", message, camera)

    def _add(self, parameter: str, message: Any, camera: int) -> None:
        [stream for stream in self.streams() if stream.parameter == parameter][camera].add(message)
