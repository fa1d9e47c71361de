"""From single messages to posed frames: colour meets depth, pose and camera model by stamp.

The same class serves the live node and recordings. It looks at headers only; pixels are decoded when a frame is wanted.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from fus3dmaps_core import messages
from fus3dmaps_core.config import ImageConfig, InputConfig
from fus3dmaps_core.errors import ConfigError, FrameError
from fus3dmaps_core.frame import Intrinsics, PosedFrame
from fus3dmaps_core.geometry.trajectory import PoseBuffer, PoseGap

_TIME_JUMP_NS = 3_000_000_000  # Delivery can swap neighbours; only another clock or a restart goes back this far.
_ASPECT_TOLERANCE = 0.01

_Stream = Literal["rgb", "depth", "pose"]


@dataclass(frozen=True)
class PairedMessages:
    """A colour and a depth image with the pose and the camera model that belong to them, not yet decoded.

    Attributes:
        stamp_ns: Stamp of the colour image, nanoseconds.
        T_world_camera: (4, 4) float64, pose of the optical frame in the map frame at that stamp.
        intrinsics: Camera model of the colour image.
        rgb: The colour image message.
        depth: The depth image message.
        rgb_topic: Topic of the colour image, for error messages.
        depth_topic: Topic of the depth image, for error messages.
    """

    stamp_ns: int
    T_world_camera: NDArray[np.float64]
    intrinsics: Intrinsics
    rgb: Any
    depth: Any
    rgb_topic: str
    depth_topic: str

    def decode(self, image: ImageConfig) -> PosedFrame:
        """The frame with its pixels, at the resolution of the messages.

        Args:
            image: ``depth_unit_m`` scales 16-bit depth.

        Raises:
            FrameError: The images or the pose are not usable.
        """
        return PosedFrame(
            self.stamp_ns,
            messages.decode_color(self.rgb, self.rgb_topic),
            messages.decode_depth(self.depth, self.depth_topic, image.depth_unit_m),
            self.intrinsics,
            self.T_world_camera,
        )


@dataclass(frozen=True)
class _Stamped:
    stamp_ns: int
    message: Any


class FramePairer:
    """Pairs each colour image with the nearest depth image and the pose at its stamp.

    Feed it with the ``add_`` methods and call :meth:`poll` after each. Whatever cannot be used is dropped and counted, never
    raised. Time is that of the stamps: an image is given up once any input has moved ``max_wait_s`` past it, so memory
    stays bounded by what arrives in that span. A stamp that goes back more than three seconds (a looped recording, a
    restarted simulation) ends what was waiting and pairing goes on from the new time. Each image gets the newest camera
    model. Not thread-safe: callers hold a lock.

    Attributes:
        received: Messages per topic, usable or not.
        drops: Messages and colour images that led to no frame, by reason: ``unknown_encoding``, ``bad_image``,
            ``size_mismatch``, ``bad_intrinsics``, ``bad_pose``, ``wrong_frame``, ``stamp_backwards``, ``stamp_repeated``,
            ``no_camera_info``, ``no_depth``, ``no_pose``, ``pose_gap``, and ``time_jump`` once per jump.
        last_drop: The latest explanation of each reason; names the topic.
    """

    def __init__(self, config: InputConfig) -> None:
        """Start empty.

        Raises:
            ConfigError: ``input.T_body_camera`` is not a pose.
        """
        try:
            self._T_body_camera = messages.transform_from(config.T_body_camera)
        except FrameError as error:
            raise ConfigError(f"parameter 'input.T_body_camera': {error}") from None
        self._config = config
        self._topics: dict[_Stream, str] = {
            "rgb": config.rgb_topic,
            "depth": config.depth_topic,
            "pose": config.pose_topic if config.pose_source == "pose" else config.odometry_topic,
        }
        self._tolerance_ns = round(config.sync_tolerance_s * 1e9)
        self._max_wait_ns = round(config.max_wait_s * 1e9)
        self._intrinsics: Intrinsics | None = None
        self._rgb: deque[_Stamped] = deque()
        self._depth: deque[_Stamped] = deque()
        self._poses = PoseBuffer(config.max_pose_gap_s)
        self._last_ns: dict[_Stream, int] = {}
        self._ready: list[PairedMessages] = []
        self.received: Counter[str] = Counter()
        self.drops: Counter[str] = Counter()
        self.last_drop: dict[str, str] = {}

    def add_rgb(self, message: Any) -> None:
        """Take a colour image (``sensor_msgs/Image``)."""
        topic = self._topics["rgb"]
        self.received[topic] += 1
        try:
            messages.check_color(message, topic)
            if self._intrinsics is not None:
                self._check_size(message, self._intrinsics)
            stamp_ns = self._advance("rgb", message)
        except FrameError as error:
            self.drop(error)
            return
        self._rgb.append(_Stamped(stamp_ns, message))

    def add_depth(self, message: Any) -> None:
        """Take a depth image (``sensor_msgs/Image``), registered to colour."""
        topic = self._topics["depth"]
        self.received[topic] += 1
        try:
            messages.check_depth(message, topic)
            stamp_ns = self._advance("depth", message)
        except FrameError as error:
            self.drop(error)
            return
        self._depth.append(_Stamped(stamp_ns, message))

    def add_camera_info(self, message: Any) -> None:
        """Take the camera model of the colour images (``sensor_msgs/CameraInfo``)."""
        topic = self._config.camera_info_topic
        self.received[topic] += 1
        try:
            self._intrinsics = messages.to_intrinsics(message, topic)
        except FrameError as error:
            self.drop(error)

    def add_pose(self, message: Any) -> None:
        """Take a pose (``geometry_msgs/PoseStamped`` or ``nav_msgs/Odometry``) of the body in the map frame."""
        topic = self._topics["pose"]
        self.received[topic] += 1
        frame = message.header.frame_id
        try:
            if frame.lstrip("/") != self._config.map_frame.lstrip("/"):
                raise FrameError(
                    f"{topic}: pose is in frame '{frame}', but parameter 'input.map_frame' is '{self._config.map_frame}'",
                    reason="wrong_frame",
                )
            T_world_body = messages.to_pose(message, topic)
            stamp_ns = self._advance("pose", message)
        except FrameError as error:
            self.drop(error)
            return
        self._poses.add(stamp_ns, T_world_body)

    def poll(self) -> list[PairedMessages]:
        """The pairs that have become complete since the last call, in stamp order (between two time jumps)."""
        self._settle(final=False)
        ready, self._ready = self._ready, []
        return ready

    def flush(self) -> list[PairedMessages]:
        """As :meth:`poll`, when nothing more will come: what still waits is paired with what is there, or dropped."""
        self._settle(final=True)
        return self.poll()

    def reset(self) -> None:
        """Forget everything that waits and the stamps seen; the camera model and the counts stay."""
        self._ready.clear()
        self._forget_time()

    def drop(self, error: FrameError) -> None:
        """Count a message that cannot be used."""
        self.drops[error.reason] += 1
        self.last_drop[error.reason] = str(error)

    def _advance(self, stream: _Stream, message: Any) -> int:
        """The message's stamp, which must be later than the stream's last one unless time has jumped back."""
        stamp_ns = messages.stamp_ns(message)
        last_ns = self._last_ns.get(stream)
        if last_ns is not None and stamp_ns <= last_ns:
            back_s = (last_ns - stamp_ns) / 1e9
            topic = self._topics[stream]
            if last_ns - stamp_ns <= _TIME_JUMP_NS:
                raise FrameError(
                    f"{topic}: stamp {_seconds(stamp_ns)} is {back_s:.3f} s behind the one before, {_seconds(last_ns)}",
                    reason="stamp_backwards" if back_s else "stamp_repeated",
                )
            self._settle(final=True)
            self._forget_time()
            self.drop(FrameError(f"{topic}: time jumped back {back_s:.1f} s to {_seconds(stamp_ns)}", reason="time_jump"))
        self._last_ns[stream] = stamp_ns
        return stamp_ns

    def _forget_time(self) -> None:
        self._rgb.clear()
        self._depth.clear()
        self._poses.clear()
        self._last_ns.clear()

    def _settle(self, final: bool) -> None:
        """Pair or drop the oldest colour images until one has to wait; with ``final`` none waits."""
        newest_ns = max(self._last_ns.values(), default=0)
        while self._rgb:
            head = self._rgb[0]
            try:
                paired = self._pair(head, final or newest_ns - head.stamp_ns > self._max_wait_ns)
            except FrameError as error:
                self.drop(error)
            else:
                if paired is None:
                    break
                self._ready.append(paired)
            self._rgb.popleft()
        # What is older than this can meet no colour image any more: colour stamps only rise.
        oldest_ns = newest_ns - self._max_wait_ns
        if self._rgb:
            oldest_ns = self._rgb[0].stamp_ns
        elif "rgb" in self._last_ns:
            oldest_ns = max(oldest_ns, self._last_ns["rgb"])
        while self._depth and self._depth[0].stamp_ns < oldest_ns - self._tolerance_ns:
            self._depth.popleft()
        self._poses.forget_before(oldest_ns)

    def _pair(self, rgb: _Stamped, final: bool) -> PairedMessages | None:
        """The complete pair, or None while something may still come; FrameError once something cannot."""
        depth = self._depth_for(rgb, final)
        T_world_body = self._pose_for(rgb, final)
        if self._intrinsics is None:
            if final:
                raise FrameError(
                    f"{self._topics['rgb']}: image at {_seconds(rgb.stamp_ns)} has no camera model, nothing usable came on"
                    f" {self._config.camera_info_topic}",
                    reason="no_camera_info",
                )
            return None
        if depth is None or T_world_body is None:
            return None
        self._check_size(rgb.message, self._intrinsics)
        self._check_same_view(rgb.message, depth.message)
        return PairedMessages(
            rgb.stamp_ns,
            T_world_body @ self._T_body_camera,
            self._intrinsics,
            rgb.message,
            depth.message,
            self._topics["rgb"],
            self._topics["depth"],
        )

    def _depth_for(self, rgb: _Stamped, final: bool) -> _Stamped | None:
        last_ns = self._last_ns.get("depth")
        # The nearest is known once depth has come as far as the colour image.
        if not final and (last_ns is None or last_ns < rgb.stamp_ns):
            return None
        nearest = min(self._depth, key=lambda depth: abs(depth.stamp_ns - rgb.stamp_ns), default=None)
        if nearest is None or abs(nearest.stamp_ns - rgb.stamp_ns) > self._tolerance_ns:
            found = "none" if nearest is None else f"the nearest is {abs(nearest.stamp_ns - rgb.stamp_ns) / 1e9:.3f} s away"
            raise FrameError(
                f"{self._topics['rgb']}: image at {_seconds(rgb.stamp_ns)} has no depth image on {self._topics['depth']}"
                f" within {self._config.sync_tolerance_s} s ({found})",
                reason="no_depth",
            )
        return nearest

    def _pose_for(self, rgb: _Stamped, final: bool) -> NDArray[np.float64] | None:
        found = self._poses.lookup(rgb.stamp_ns)
        if not isinstance(found, PoseGap):
            return found
        if found is PoseGap.AFTER_LAST and not final:
            return None
        if found is PoseGap.TOO_WIDE:
            raise FrameError(
                f"{self._topics['pose']}: poses around {_seconds(rgb.stamp_ns)} are more than"
                f" {self._config.max_pose_gap_s} s apart",
                reason="pose_gap",
            )
        first_ns, last_ns = self._poses.first_ns, self._poses.last_ns
        span = (
            "none came" if first_ns is None or last_ns is None else f"they span {_seconds(first_ns)} to {_seconds(last_ns)}"
        )
        raise FrameError(
            f"{self._topics['rgb']}: image at {_seconds(rgb.stamp_ns)} has no pose on {self._topics['pose']} ({span})",
            reason="no_pose",
        )

    def _check_size(self, rgb: Any, intrinsics: Intrinsics) -> None:
        if (rgb.width, rgb.height) != (intrinsics.width, intrinsics.height):
            raise FrameError(
                f"{self._topics['rgb']}: image is {rgb.width}x{rgb.height} but {self._config.camera_info_topic} says"
                f" {intrinsics.width}x{intrinsics.height}",
                reason="size_mismatch",
            )

    def _check_same_view(self, rgb: Any, depth: Any) -> None:
        """Registered depth may be of another resolution, not of another shape."""
        if abs(depth.width * rgb.height / (depth.height * rgb.width) - 1.0) > _ASPECT_TOLERANCE:
            raise FrameError(
                f"{self._topics['depth']}: image is {depth.width}x{depth.height}, which cannot cover the view of"
                f" {self._topics['rgb']} with {rgb.width}x{rgb.height}",
                reason="size_mismatch",
            )


def _seconds(stamp_ns: int) -> str:
    return f"{stamp_ns // 1_000_000_000}.{stamp_ns % 1_000_000_000:09d}"
