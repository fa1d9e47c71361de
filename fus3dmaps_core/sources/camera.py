"""Pairing for one camera: each colour image with depth, pose and camera model by stamp."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

from fus3dmaps_core.config.input import InputConfig
from fus3dmaps_core.errors import FrameError
from fus3dmaps_core.ledger import Drops
from fus3dmaps_core.messages import fields
from fus3dmaps_core.messages.images import check_color, check_depth, image_size
from fus3dmaps_core.sources.paired import CameraModel, PairedMessages, UnregisteredDepth, check_size
from fus3dmaps_core.sources.poses import FOREVER_NS, Moment, Mounting, PoseProvider
from fus3dmaps_core.sources.streams import CameraTopics, Stream, image_type
from fus3dmaps_core.sources.timeline import Timeline, seconds

_ASPECT_TOLERANCE = 0.01


@dataclass(frozen=True)
class _Stamped:
    stamp_ns: int
    message: Any

    @property
    def frame(self) -> str:
        return str(self.message.header.frame_id)


class _Models:
    """The camera models of a ``camera_info`` topic over time."""

    def __init__(self, config: InputConfig, topic: str, drops: Drops) -> None:
        self.topic = topic
        self._rectify = config.rectify
        self._drops = drops
        self._models: deque[tuple[int, CameraModel]] = deque()

    def add(self, message: Any) -> None:
        try:
            distortion = fields.to_distortion(message, self.topic) if self._rectify else None
            model = CameraModel(fields.to_intrinsics(message, self.topic), distortion)
        except FrameError as error:
            self._drops.add_error(error)
            return
        if self._models:
            known = self._models[-1][1]
            if model == known:
                return
            old, new = known.intrinsics, model.intrinsics
            changes = f"from {old} to {new}" if old != new else f"in its lens's distortion, now {distortion}"
            self._drops.add("intrinsics_changed", f"{self.topic}: camera model changed {changes}")
        stamp_ns = fields.stamp_ns(message)
        while self._models and self._models[-1][0] >= stamp_ns:
            self._models.pop()
        self._models.append((stamp_ns, model))

    def at(self, stamp_ns: int) -> CameraModel | None:
        """Return the latest model up to the stamp, or the first one if all are later."""
        earlier = [model for start_ns, model in self._models if start_ns <= stamp_ns]
        if earlier:
            return earlier[-1]
        return self._models[0][1] if self._models else None

    def forget_before(self, stamp_ns: int) -> None:
        while len(self._models) > 1 and self._models[1][0] <= stamp_ns:
            self._models.popleft()

    def start_anew(self) -> None:
        """Keep only the latest model, for all of the new time: a new clock does not change the camera."""
        if self._models:
            self._models = deque([(0, self._models[-1][1])])


class CameraPairer:
    """Pairs each colour image with the nearest depth image and the pose at its stamp; see :class:`FramePairer`."""

    def __init__(
        self,
        config: InputConfig,
        topics: CameraTopics,
        poses: PoseProvider,
        mounting: Mounting,
        camera_frame: str,
        timeline: Timeline,
        drops: Drops,
    ) -> None:
        """Start empty.

        Args:
            config: Tolerances and transports.
            topics: Topics of this camera.
            poses: Poses of the body; shared with the other cameras.
            mounting: Mounting of the camera on the body.
            camera_frame: Its optical frame in TF; if empty, the frame named by the images.
            timeline: Stamps of all inputs.
            drops: Counts the drops of all inputs.
        """
        self._config = config
        self._topics = topics
        self._poses = poses
        self._mounting = mounting
        self._camera_frame = camera_frame
        self._timeline = timeline
        self._drops = drops
        self._tolerance_ns = round(config.sync_tolerance_s * 1e9)
        self._max_wait_ns = round(config.max_wait_s * 1e9)
        self._rgb: deque[_Stamped] = deque()
        self._depth: deque[_Stamped] = deque()
        self._frames: dict[str, str] = {}
        self._models = _Models(config, topics.camera_info, drops)
        self._depth_models = None if topics.depth_camera_info is None else _Models(config, topics.depth_camera_info, drops)

    @property
    def oldest_ns(self) -> int | None:
        """Stamp of the oldest waiting colour image, nanoseconds."""
        return self._rgb[0].stamp_ns if self._rgb else None

    def streams(self) -> Iterator[Stream]:
        """Yield the topics of this camera."""
        config, topics = self._config, self._topics
        info_type, info_qos = "sensor_msgs/msg/CameraInfo", config.camera_info_qos
        rgb_type, depth_type = image_type(config.rgb_transport), image_type(config.depth_transport)
        yield Stream(topics.rgb, "rgb", rgb_type, "input.rgb_topic", config.rgb_qos, self.add_rgb)
        yield Stream(topics.depth, "depth", depth_type, "input.depth_topic", config.depth_qos, self.add_depth)
        parameter = "input.camera_info_topic"
        yield Stream(topics.camera_info, "camera_info", info_type, parameter, info_qos, self.add_camera_info)
        if topics.depth_camera_info is not None:
            parameter, add = "input.depth_camera_info_topic", self.add_depth_camera_info
            yield Stream(topics.depth_camera_info, "camera_info", info_type, parameter, info_qos, add)

    def add_rgb(self, message: Any) -> None:
        """Take a colour image (``sensor_msgs/Image`` or ``CompressedImage``)."""
        topic = self._topics.rgb
        try:
            check_color(message, topic)
            model = self._models.at(fields.stamp_ns(message))
            if model is not None:
                check_size(image_size(message, topic), model.intrinsics, topic, self._topics.camera_info)
            stamped = _Stamped(self._timeline.advance(topic, message), message)
        except FrameError as error:
            self._drops.add_error(error)
            return
        self._rgb.append(stamped)
        self._follow_frame(topic, stamped.frame)

    def add_depth(self, message: Any) -> None:
        """Take a depth image (``sensor_msgs/Image`` or ``CompressedImage``)."""
        topic = self._topics.depth
        try:
            check_depth(message, topic)
            stamped = _Stamped(self._timeline.advance(topic, message), message)
        except FrameError as error:
            self._drops.add_error(error)
            return
        self._depth.append(stamped)
        self._follow_frame(topic, stamped.frame)

    def add_camera_info(self, message: Any) -> None:
        """Take the camera model of the colour images (``sensor_msgs/CameraInfo``)."""
        self._models.add(message)

    def add_depth_camera_info(self, message: Any) -> None:
        """Take the camera model of depth images that are not registered (``sensor_msgs/CameraInfo``)."""
        if self._depth_models is not None:
            self._depth_models.add(message)

    def settle(self, final: bool) -> list[PairedMessages]:
        """Pair or drop colour images, oldest first, until one has to wait. With ``final`` none waits."""
        ready = []
        newest_ns = self._timeline.newest_ns
        while self._rgb:
            head = self._rgb[0]
            try:
                paired = self._pair(head, FOREVER_NS if final else newest_ns - head.stamp_ns)
            except FrameError as error:
                self._drops.add_error(error)
            else:
                if paired is None:
                    break
                ready.append(paired)
            self._rgb.popleft()
        return ready

    def forget_needless(self) -> int:
        """Remove messages that no colour image can need any more.

        Returns:
            The earliest stamp, nanoseconds, whose messages may still be needed.
        """
        # Older messages can match no colour image any more, because colour stamps only rise.
        oldest_ns = self._timeline.newest_ns - self._max_wait_ns
        if self._rgb:
            oldest_ns = self._rgb[0].stamp_ns
        elif self._topics.rgb in self._timeline.last_ns:
            oldest_ns = max(oldest_ns, self._timeline.last_ns[self._topics.rgb])
        while self._depth and self._depth[0].stamp_ns < oldest_ns - self._tolerance_ns:
            self._depth.popleft()
        self._models.forget_before(oldest_ns)
        if self._depth_models is not None:
            self._depth_models.forget_before(oldest_ns - self._tolerance_ns)
        return oldest_ns

    def start_anew(self) -> None:
        """Remove waiting images; the camera model stays."""
        self._rgb.clear()
        self._depth.clear()
        self._models.start_anew()
        if self._depth_models is not None:
            self._depth_models.start_anew()

    def _follow_frame(self, topic: str, frame: str) -> None:
        known = self._frames.get(topic, frame)
        self._frames[topic] = frame
        if frame != known:
            self._drops.add("frame_id_changed", f"{topic}: frame_id changed from '{known}' to '{frame}'")

    def _pair(self, rgb: _Stamped, waited_ns: int) -> PairedMessages | None:
        """Return the complete pair, or None while a part may still come; raise FrameError once a part cannot come."""
        final = waited_ns > self._max_wait_ns
        moment = Moment(self._topics.rgb, self._camera_frame or rgb.frame, rgb.stamp_ns, waited_ns)
        depth = self._depth_for(rgb, final)
        T_world_body = self._poses.at(moment)
        if T_world_body is None:
            return None
        T_body_camera = self._mounting.body_camera(moment, self._poses.body_frame(moment))
        model = self._model_for(rgb, self._models, final, "rgb")
        if depth is None or model is None or T_body_camera is None:
            return None
        size = image_size(rgb.message, self._topics.rgb)
        check_size(size, model.intrinsics, self._topics.rgb, self._topics.camera_info)
        unregistered = None
        if self._depth_models is None:
            self._check_same_view(size, image_size(depth.message, self._topics.depth))
        else:
            unregistered = self._unregistered(depth, self._depth_models, moment, final)
            if unregistered is None:
                return None
        return PairedMessages(
            rgb.stamp_ns,
            T_world_body @ T_body_camera,
            model,
            rgb.message,
            depth.message,
            self._topics.rgb,
            self._topics.depth,
            unregistered,
        )

    def _depth_for(self, rgb: _Stamped, final: bool) -> _Stamped | None:
        last_ns = self._timeline.last_ns.get(self._topics.depth)
        # The nearest depth image is known once depth has reached the stamp of the colour image.
        if not final and (last_ns is None or last_ns < rgb.stamp_ns):
            return None
        nearest = min(self._depth, key=lambda depth: abs(depth.stamp_ns - rgb.stamp_ns), default=None)
        if nearest is None or abs(nearest.stamp_ns - rgb.stamp_ns) > self._tolerance_ns:
            found = "none" if nearest is None else f"the nearest is {abs(nearest.stamp_ns - rgb.stamp_ns) / 1e9:.3f} s away"
            raise FrameError(
                f"{self._topics.rgb}: image at {seconds(rgb.stamp_ns)} has no depth image on {self._topics.depth}"
                f" within {self._config.sync_tolerance_s} s ({found})",
                reason="no_depth",
            )
        return nearest

    def _model_for(
        self, image: _Stamped, models: _Models, final: bool, stream: Literal["rgb", "depth"]
    ) -> CameraModel | None:
        model = models.at(image.stamp_ns)
        if model is None and final:
            topic = self._topics.rgb if stream == "rgb" else self._topics.depth
            raise FrameError(
                f"{topic}: image at {seconds(image.stamp_ns)} has no camera model, nothing usable came on {models.topic}",
                reason="no_camera_info",
            )
        return model

    def _unregistered(self, depth: _Stamped, models: _Models, moment: Moment, final: bool) -> UnregisteredDepth | None:
        model = self._model_for(depth, models, final, "depth")
        T_rgb_depth = self._mounting.rgb_depth(moment, depth.frame)
        if model is None or T_rgb_depth is None:
            return None
        topic = self._topics.depth
        check_size(image_size(depth.message, topic), model.intrinsics, topic, models.topic)
        return UnregisteredDepth(model, T_rgb_depth)

    def _check_same_view(self, rgb_size: tuple[int, int], depth_size: tuple[int, int]) -> None:
        """Raise FrameError if registered depth has another aspect ratio than colour; its resolution may differ."""
        (rgb_width, rgb_height), (width, height) = rgb_size, depth_size
        if abs(width * rgb_height / (height * rgb_width) - 1.0) > _ASPECT_TOLERANCE:
            raise FrameError(
                f"{self._topics.depth}: image is {width}x{height}, which cannot cover the view of"
                f" {self._topics.rgb} with {rgb_width}x{rgb_height}",
                reason="size_mismatch",
            )
