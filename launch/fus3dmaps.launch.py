"""Start the mapper node, and RViz or the Foxglove bridge where asked: ros2 launch fus3dmaps_ros fus3dmaps.launch.py -s."""
# ruff: noqa: I001  (this folder's name makes the package `launch` look like one of ours)

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

CAMERAS = ("none", "d435", "d455", "zed", "azure_kinect", "femto", "oak_d", "simulation")
BOOLEANS = ("true", "false", "True", "False")

# Launch argument, parameters that it sets, description; left empty it sets nothing.
OVERRIDES = (
    ("encoder", ("encoder.name",), "Encoder trio, e.g. lite."),
    ("device", ("encoder.device", "map.device"), "Torch device of encoders and map, e.g. cpu or cuda:0."),
    ("rgb_topic", ("input.rgb_topic",), "Colour images, without the transport's suffix."),
    ("depth_topic", ("input.depth_topic",), "Depth images, without the transport's suffix."),
    ("camera_info_topic", ("input.camera_info_topic",), "Camera model of the colour images."),
    ("pose_source", ("input.pose_source",), "pose, pose_with_covariance, odometry or tf."),
    ("pose_topic", ("input.pose_topic",), "Poses, for pose_source pose."),
    ("pose_with_covariance_topic", ("input.pose_with_covariance_topic",), "Poses, for pose_source pose_with_covariance."),
    ("odometry_topic", ("input.odometry_topic",), "Poses, for pose_source odometry."),
)
# What RViz shows of the node; its configuration names them without a namespace.
SHOWN = ("map", "labels", "similarity", "instances", "answer", "detections", "path")


def generate_launch_description():
    """Declare the arguments, whose values decide on the nodes."""
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "camera",
                default_value="none",
                choices=list(CAMERAS),
                description="Preset of topics and ranges: a file in config/presets. none: topics by the node's own names.",
            ),
            DeclareLaunchArgument(
                "params_file", default_value="", description="Parameter file of your own; wins over the preset."
            ),
            *(
                DeclareLaunchArgument(argument, default_value="", description=description)
                for argument, _, description in OVERRIDES
            ),
            DeclareLaunchArgument(
                "window_radius_m", default_value="", description="Radius of the dense layer's sliding window, metres."
            ),
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node and its inputs."),
            DeclareLaunchArgument(
                "use_sim_time", default_value="false", choices=list(BOOLEANS), description="Take time from /clock."
            ),
            DeclareLaunchArgument(
                "autostart",
                default_value="",
                choices=["", *BOOLEANS],
                description="false: wait, unconfigured, for a manager of lifecycle nodes; true: load and map at once.",
            ),
            DeclareLaunchArgument("log_level", default_value="info", description="debug, info, warn, error or fatal."),
            DeclareLaunchArgument("rviz", default_value="false", choices=list(BOOLEANS), description="Start RViz as well."),
            DeclareLaunchArgument(
                "foxglove",
                default_value="false",
                choices=list(BOOLEANS),
                description="Start foxglove_bridge as well; open config/fus3dmaps_foxglove.json in Foxglove.",
            ),
            OpaqueFunction(function=nodes),
        ]
    )


def nodes(context):
    """Make the nodes for the values that the arguments have."""
    given = context.launch_configurations
    config = Path(get_package_share_directory("fus3dmaps_ros")) / "config"
    clock = {"use_sim_time": is_true(given["use_sim_time"])}
    started = [
        Node(
            package="fus3dmaps_ros",
            executable="mapper",
            name="fus3dmaps",
            namespace=given["namespace"],
            parameters=[*parameter_files(given, config), {**overrides(given), **clock}],
            ros_arguments=["--log-level", given["log_level"]],
            output="screen",
        )
    ]
    if is_true(given["rviz"]):
        prefix = given["namespace"].strip("/")
        started.append(
            Node(
                package="rviz2",
                executable="rviz2",
                name="rviz",
                arguments=["-d", str(config / "fus3dmaps.rviz")],
                parameters=[clock],
                remappings=[(f"/fus3dmaps/{topic}", f"/{prefix}/fus3dmaps/{topic}") for topic in SHOWN] if prefix else [],
            )
        )
    if is_true(given["foxglove"]):
        started.append(
            Node(package="foxglove_bridge", executable="foxglove_bridge", name="foxglove_bridge", parameters=[clock])
        )
    return started


def parameter_files(given, config):
    """List the node's parameter files, of which the later ones win: defaults, the camera's preset, the user's own."""
    files = [str(config / "fus3dmaps.yaml")]
    if given["camera"] != "none":
        files.append(str(config / "presets" / f"{given['camera']}.yaml"))
    if given["params_file"]:
        files.append(given["params_file"])
    return files


def overrides(given):
    """Return the parameters that the arguments set by themselves."""
    values = {
        # Text stays text: a topic or a device must not be read as a number.
        parameter: ParameterValue(given[argument], value_type=str)
        for argument, parameters, _ in OVERRIDES
        for parameter in parameters
        if given[argument]
    }
    if given["window_radius_m"]:
        values["fusion.window_radius_m"] = float(given["window_radius_m"])
    if given["autostart"]:
        values["node.autostart"] = is_true(given["autostart"])
    return values


def is_true(text):
    """Tell whether an argument says true."""
    return text.lower() == "true"
