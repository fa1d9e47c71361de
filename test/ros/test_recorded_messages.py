"""What the core writes and pairs, seen by ROS itself: its deserialiser and its own message objects."""

from __future__ import annotations

import numpy as np
from fed_pairer import FedPairer
from geometry_msgs.msg import PoseStamped
from rclpy.serialization import deserialize_message
from recorded_frames import assert_same_frames, noise_frames
from sensor_msgs.msg import CameraInfo, Image

from fus3dmaps_core.config.input import InputConfig
from fus3dmaps_core.config.schema import ImageConfig
from fus3dmaps_core.recordings.reader import RecordingReader
from fus3dmaps_core.recordings.writer import RecordingWriter


def test_recorded_messages_pass_through_ros_and_the_pairer(tmp_path):
    frames = noise_frames(3, 64, 48)
    with RecordingWriter(tmp_path / "bag.mcap") as writer:
        for frame in frames:
            writer.write(frame)
    pairer = FedPairer(InputConfig())
    inputs = {
        "/rgb/camera_info": (CameraInfo, pairer.add_camera_info),
        "/pose": (PoseStamped, pairer.add_pose),
        "/depth/image": (Image, pairer.add_depth),
        "/rgb/image": (Image, pairer.add_rgb),
    }
    with RecordingReader(tmp_path / "bag.mcap") as reader:
        for raw in reader.messages():
            kind, add = inputs[raw.topic]
            message = deserialize_message(raw.data, kind)
            assert message.header.frame_id == ("map" if kind is PoseStamped else "camera_optical_frame")
            if kind is CameraInfo:
                np.testing.assert_array_equal(message.k, [150, 0, 79.5, 0, 151, 60.25, 0, 0, 1])
                assert message.distortion_model == "plumb_bob"
            add(message)
    assert_same_frames([paired.decode(ImageConfig()) for paired in pairer.poll()], frames)
    assert not pairer.drops.counts()
