"""Writing of posed frames as a rosbag2 recording in one MCAP file, without ROS."""

from __future__ import annotations

from contextlib import suppress
from io import BufferedWriter
from pathlib import Path
from types import TracebackType
from typing import Any, Literal

import numpy as np
from mcap.writer import CompressionType, Writer
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from fus3dmaps_core.config.input import InputConfig
from fus3dmaps_core.errors import ConfigError, FrameError, RecordingError
from fus3dmaps_core.frame import Intrinsics, PosedFrame
from fus3dmaps_core.messages.fields import transform_from
from fus3dmaps_core.version import __version__

CAMERA_FRAME = "camera_optical_frame"

_COMPRESSIONS = {"lz4": CompressionType.LZ4, "zstd": CompressionType.ZSTD, "none": CompressionType.NONE}
_WRITTEN = {
    "cameras": "",
    "rgb_transport": "raw",
    "depth_transport": "raw",
    "depth_registered": True,
    "pose_source": "pose",
    "extrinsic_source": "parameter",
}
_MAX_DEPTH_MM = 65534.0  # Some readers take 65535 for "no reading".
_OFFERED_QOS = """\
- history: keep_last
  depth: 10
  reliability: reliable
  durability: volatile
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: automatic
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false"""


class RecordingWriter:
    """Writes camera model, pose, depth and colour image of each frame, in this order, with the frame's stamp.

    The file has the form of ``ros2 bag record --storage mcap``: profile ``ros2``, CDR messages, full message definitions.
    Depth is 16UC1 millimetres (REP-118; 0 where there is no reading or beyond 65.5 m), colour rgb8. Poses are PoseStamped
    on the configured pose topic; a reader with the same configuration gets the camera's pose back. Equal frames give equal
    bytes. The file gets its name only when the ``with`` block ends without an exception.

    Attributes:
        frame_count: Frames written so far.
    """

    def __init__(
        self,
        path: Path,
        config: InputConfig | None = None,
        *,
        overwrite: bool = False,
        compression: Literal["lz4", "zstd", "none"] = "lz4",
    ) -> None:
        """Start a recording.

        Args:
            path: File to write, must end in ``.mcap``; its directory is made if missing.
            config: Topics, the map frame and the mounting of the camera.
            overwrite: Whether an existing file is replaced.
            compression: Of the chunks. lz4 writes about 1.5 times as fast as zstd, at 1.3 times the size.

        Raises:
            RecordingError: The name is unsuitable, the file exists or cannot be written.
            ConfigError: ``input.T_body_camera`` is not a pose, or the configuration names a kind of input that cannot
                be written; the message names the parameter.
        """
        self._config = config or InputConfig()
        for name, value in _WRITTEN.items():
            if getattr(self._config, name) != value:
                raise ConfigError(f"parameter 'input.{name}': a recording can only be written with {value!r}")
        try:
            self._T_camera_body = np.linalg.inv(transform_from(self._config.T_body_camera))
        except FrameError as error:
            raise ConfigError(f"parameter 'input.T_body_camera': {error}") from None
        if path.suffix != ".mcap":
            raise RecordingError(f"recording '{path}' must end in .mcap")
        if path.exists() and not overwrite:
            raise RecordingError(f"recording '{path}' exists already")
        self._path = path
        self._partial = path.with_name(f".{path.name}.partial")
        self._typestore = get_typestore(Stores.ROS2_JAZZY)
        self._last_ns = -1
        self.frame_count = 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file: BufferedWriter = self._partial.open("wb")
        except OSError as error:
            raise self._failure(error) from error
        self._writer = Writer(self._file, compression=_COMPRESSIONS[compression])
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._writer.start(profile="ros2", library=f"fus3dmaps {__version__}")
        self._add_channel(self._config.camera_info_topic, "sensor_msgs/msg/CameraInfo")
        self._add_channel(self._config.pose_topic, "geometry_msgs/msg/PoseStamped")
        self._add_channel(self._config.depth_topic, "sensor_msgs/msg/Image")
        self._add_channel(self._config.rgb_topic, "sensor_msgs/msg/Image")

    def write(self, frame: PosedFrame) -> None:
        """Append a frame.

        Raises:
            RecordingError: The stamp is not later than the last one, or the disk is full.
        """
        if frame.stamp_ns <= self._last_ns:
            raise RecordingError(f"recording '{self._path}': stamp {frame.stamp_ns} is not later than {self._last_ns}")
        header = self._header(frame.stamp_ns, CAMERA_FRAME)
        try:
            self._add(self._config.camera_info_topic, frame.stamp_ns, self._camera_info(header, frame.intrinsics))
            self._add(self._config.pose_topic, frame.stamp_ns, self._pose(frame))
            self._add(self._config.depth_topic, frame.stamp_ns, self._image(header, "16UC1", _millimetres(frame.depth_m)))
            self._add(self._config.rgb_topic, frame.stamp_ns, self._image(header, "rgb8", frame.rgb))
        except OSError as error:
            raise self._failure(error) from error
        self._last_ns = frame.stamp_ns
        self.frame_count += 1

    def __enter__(self) -> RecordingWriter:
        """Return the writer: the file is open already."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Finish the file and give it its name; after an exception, remove what was written.

        Raises:
            RecordingError: The disk is full, or no frame was written.
        """
        try:
            if kind is None:
                if self.frame_count == 0:
                    raise RecordingError(f"recording '{self._path}' was given no frames and is not written")
                self._writer.finish()
                self._file.close()
                self._partial.replace(self._path)
        except OSError as failure:
            raise self._failure(failure) from failure
        finally:
            self._discard()

    def _add_channel(self, name: str, msgtype: str) -> None:
        if msgtype not in self._schemas:
            definition, _ = self._typestore.generate_msgdef(msgtype, ros_version=2)
            self._schemas[msgtype] = self._writer.register_schema(msgtype, "ros2msg", definition.encode())
        metadata = {
            "offered_qos_profiles": _OFFERED_QOS,
            "topic_type_hash": self._typestore.hash_rihs01(msgtype),
        }
        topic = "/" + name.lstrip("/")
        self._channels[name] = self._writer.register_channel(topic, "cdr", self._schemas[msgtype], metadata)

    def _add(self, name: str, stamp_ns: int, message: Any) -> None:
        data = bytes(self._typestore.serialize_cdr(message, message.__msgtype__))
        self._writer.add_message(self._channels[name], log_time=stamp_ns, publish_time=stamp_ns, data=data)

    def _make(self, msgtype: str, *values: Any) -> Any:
        return self._typestore.types[msgtype](*values)

    def _header(self, stamp_ns: int, frame_id: str) -> Any:
        stamp = self._make("builtin_interfaces/msg/Time", *divmod(stamp_ns, 1_000_000_000))
        return self._make("std_msgs/msg/Header", stamp, frame_id)

    def _camera_info(self, header: Any, intrinsics: Intrinsics) -> Any:
        K = intrinsics.matrix
        P = np.hstack([K, np.zeros((3, 1))])
        no_region = self._make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        return self._make(
            "sensor_msgs/msg/CameraInfo",
            header,
            intrinsics.height,
            intrinsics.width,
            "plumb_bob",
            np.zeros(5),
            K.ravel(),
            np.eye(3).ravel(),
            P.ravel(),
            0,
            0,
            no_region,
        )

    def _pose(self, frame: PosedFrame) -> Any:
        T_world_body = frame.T_world_camera @ self._T_camera_body
        position = self._make("geometry_msgs/msg/Point", *T_world_body[:3, 3].tolist())
        quaternion = Rotation.from_matrix(T_world_body[:3, :3]).as_quat(canonical=True)
        orientation = self._make("geometry_msgs/msg/Quaternion", *quaternion.tolist())
        pose = self._make("geometry_msgs/msg/Pose", position, orientation)
        return self._make("geometry_msgs/msg/PoseStamped", self._header(frame.stamp_ns, self._config.map_frame), pose)

    def _image(self, header: Any, encoding: str, pixels: NDArray[Any]) -> Any:
        height, width = pixels.shape[:2]
        little_endian = np.ascontiguousarray(pixels, dtype=pixels.dtype.newbyteorder("<"))
        data = little_endian.reshape(-1).view(np.uint8)
        return self._make("sensor_msgs/msg/Image", header, height, width, encoding, 0, data.size // height, data)

    def _discard(self) -> None:
        # On a full disk closing fails again; the data is not wanted any more.
        with suppress(OSError):
            self._file.close()
        self._partial.unlink(missing_ok=True)

    def _failure(self, error: OSError) -> RecordingError:
        return RecordingError(f"cannot write recording '{self._path}': {error.strerror}")


def _millimetres(depth_m: NDArray[np.float32]) -> NDArray[np.uint16]:
    depth_mm = np.rint(depth_m.astype(np.float64) * 1000.0)
    usable = (depth_mm > 0) & (depth_mm <= _MAX_DEPTH_MM)  # NaN gives False.
    return np.where(usable, depth_mm, 0.0).astype(np.uint16)
