"""Starts the mapper node, and RViz where asked: ros2 launch fus3dmaps_ros fus3dmaps.launch.py --show-args."""
# ruff: noqa: I001  (this folder's name makes the package `launch` look like one of ours)

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

# Launch argument, the node's own name for the topic, description.
TOPICS = (
    ("rgb_topic", "rgb/image", "Colour images (sensor_msgs/Image)."),
    ("depth_topic", "depth/image", "Depth images registered to colour (sensor_msgs/Image)."),
    ("camera_info_topic", "rgb/camera_info", "Camera model of the colour images (sensor_msgs/CameraInfo)."),
    ("pose_topic", "pose", "Camera poses (geometry_msgs/PoseStamped), for input.pose_source 'pose'."),
    ("odometry_topic", "odom", "Camera poses (nav_msgs/Odometry), for input.pose_source 'odometry'."),
)


def generate_launch_description():
    """Declare the arguments and the nodes."""
    share = Path(get_package_share_directory("fus3dmaps_ros"))
    arguments = [
        DeclareLaunchArgument(
            "params_file", default_value=str(share / "config" / "fus3dmaps.yaml"), description="Parameter file."
        ),
        DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node and its inputs."),
        DeclareLaunchArgument("use_sim_time", default_value="false", description="Take time from /clock."),
        DeclareLaunchArgument("log_level", default_value="info", description="debug, info, warn, error or fatal."),
        DeclareLaunchArgument("rviz", default_value="false", description="Start RViz as well."),
        *(
            DeclareLaunchArgument(argument, default_value=topic, description=description)
            for argument, topic, description in TOPICS
        ),
    ]
    mapper = Node(
        package="fus3dmaps_ros",
        executable="mapper",
        name="fus3dmaps",
        namespace=LaunchConfiguration("namespace"),
        parameters=[LaunchConfiguration("params_file"), {"use_sim_time": LaunchConfiguration("use_sim_time")}],
        remappings=[(topic, LaunchConfiguration(argument)) for argument, topic, _ in TOPICS],
        ros_arguments=["--log-level", LaunchConfiguration("log_level")],
        output="screen",
    )
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        name="rviz",
        arguments=["-d", str(share / "config" / "fus3dmaps.rviz")],
        parameters=[{"use_sim_time": LaunchConfiguration("use_sim_time")}],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return LaunchDescription([*arguments, mapper, rviz])
