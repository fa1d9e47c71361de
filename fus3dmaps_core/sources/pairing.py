"""Pairing of single messages by stamp: colour with depth, pose and camera model, for one camera or several.

The same class serves the live node and recordings. It only reads headers; pixels are decoded when a frame is wanted.
"""

from __future__ import annotations

from typing import Any

from fus3dmaps_core.config.input import InputConfig
from fus3dmaps_core.errors import ConfigError, FrameError
from fus3dmaps_core.ledger import Drops
from fus3dmaps_core.messages.fields import to_pose
from fus3dmaps_core.sources.camera import CameraPairer
from fus3dmaps_core.sources.paired import PairedMessages
from fus3dmaps_core.sources.poses import BufferedPoses, Mounting, PoseProvider, TransformPoses
from fus3dmaps_core.sources.streams import Stream, camera_topics, pose_parameter, pose_topic, pose_type, uses_tf
from fus3dmaps_core.sources.timeline import Timeline
from fus3dmaps_core.sources.transforms import TransformBuffer

__all__ = ["FramePairer", "PairedMessages"]


class FramePairer:
    """Pairs each colour image with the nearest depth image and the pose at its stamp.

    Hand it messages through its :meth:`streams` and call :meth:`poll` after each. Messages that
    cannot be used are dropped and counted; nothing is raised. Time is the time of the stamps: an image is dropped once any
    input is ``max_wait_s`` (for a transform: ``tf_timeout_s``) past it, which bounds the memory. If a stamp goes back more
    than three seconds (a looped recording, a restarted simulation), waiting images are paired or dropped and pairing goes
    on from the new time. A camera model is valid from its stamp until a different one comes. Several cameras share the poses
    and the clock; their frames come in the order of their stamps. Not thread-safe: callers hold a lock.

    Attributes:
        drops: Messages and colour images that led to no frame, by reason: ``unknown_encoding``, ``bad_image``,
            ``size_mismatch``, ``bad_intrinsics``, ``bad_pose``, ``bad_transform``, ``wrong_frame``, ``stamp_backwards``,
            ``stamp_repeated``, ``no_camera_info``, ``no_depth``, ``no_pose``, ``pose_gap``, ``tf_unknown_frame``,
            ``tf_not_connected``; and once per change, without losing a frame: ``time_jump``, ``intrinsics_changed``,
            ``frame_id_changed``.
    """

    def __init__(self, config: InputConfig, transforms: TransformBuffer | None = None) -> None:
        """Start empty.

        Args:
            config: Topics, pose source, mounting of the cameras.
            transforms: TF, needed by some pose and extrinsic sources.

        Raises:
            ConfigError: ``input.T_body_camera`` or ``input.T_rgb_depth`` is not a pose, or TF is needed and not given.
        """
        if transforms is None and uses_tf(config):
            parameter = "pose_source" if config.pose_source == "tf" else "extrinsic_source"
            raise ConfigError(f"parameter 'input.{parameter}': there is no TF to look up in")
        self._config = config
        self.drops = Drops()
        self._timeline = Timeline(self.drops, lambda: self._settle(final=True), self._start_anew)
        self._buffered = BufferedPoses(config)
        self._poses: PoseProvider = self._buffered
        if config.pose_source == "tf" and transforms is not None:
            self._poses = TransformPoses(config, transforms)
        self._transforms = transforms
        topics = camera_topics(config)
        frames = [frame.strip() for frame in config.camera_frame.split(",")] if config.camera_frame else [""] * len(topics)
        self._cameras = [
            CameraPairer(config, own, self._poses, Mounting(config, i, transforms), frames[i], self._timeline, self.drops)
            for i, own in enumerate(topics)
        ]
        self._held: list[PairedMessages] = []
        self._ready: list[PairedMessages] = []

    def streams(self) -> list[Stream]:
        """List every topic to listen to except TF: those of the cameras, then the poses."""
        streams = [stream for camera in self._cameras for stream in camera.streams()]
        msgtype = pose_type(self._config)
        if msgtype is not None:
            parameter = f"input.{pose_parameter(self._config)}"
            topic, profile = pose_topic(self._config), self._config.pose_qos
            streams.append(Stream(topic, "pose", msgtype, parameter, profile, self.add_pose))
        return streams

    def add_pose(self, message: Any) -> None:
        """Take a pose of the body in the map frame.

        Args:
            message: ``geometry_msgs/PoseStamped``, ``PoseWithCovarianceStamped`` or ``nav_msgs/Odometry``.
        """
        topic = pose_topic(self._config)
        frame = message.header.frame_id
        try:
            if frame.lstrip("/") != self._config.map_frame.lstrip("/"):
                raise FrameError(
                    f"{topic}: pose is in frame '{frame}', but parameter 'input.map_frame' is '{self._config.map_frame}'",
                    reason="wrong_frame",
                )
            T_world_body = to_pose(message, topic)
            stamp_ns = self._timeline.advance(topic, message)
        except FrameError as error:
            self.drops.add_error(error)
            return
        self._buffered.child_frame = getattr(message, "child_frame_id", "")
        self._buffered.add(stamp_ns, T_world_body)

    def poll(self) -> list[PairedMessages]:
        """Return the pairs completed since the last call, in stamp order (between two time jumps)."""
        self._settle(final=False)
        ready, self._ready = self._ready, []
        return ready

    def flush(self) -> list[PairedMessages]:
        """Return the last pairs when no more messages will come: what waits is paired with what is there, or dropped."""
        self._settle(final=True)
        return self.poll()

    def reset(self) -> None:
        """Remove everything that waits and the stamps seen; camera models and counts stay."""
        self._ready.clear()
        self._held.clear()
        self._timeline.clear()

    def _start_anew(self) -> None:
        for camera in self._cameras:
            camera.start_anew()
        self._buffered.clear()
        if self._transforms is not None:
            self._transforms.clear()

    def _settle(self, final: bool) -> None:
        for camera in self._cameras:
            self._held += camera.settle(final)
        self._held.sort(key=lambda paired: paired.stamp_ns)
        # A frame is ready once no camera has an earlier image that may still become a frame.
        waiting = [camera.oldest_ns for camera in self._cameras if camera.oldest_ns is not None]
        earliest_ns = min(waiting, default=None)
        while self._held and (earliest_ns is None or self._held[0].stamp_ns <= earliest_ns):
            self._ready.append(self._held.pop(0))
        self._poses.forget_before(min(camera.forget_needless() for camera in self._cameras))
