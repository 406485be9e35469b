"""Start the localizer:

    ros2 launch igaussian_ros localizer.launch.py map_path:=/maps/room.igmap \
        image_topic:=/camera/image_raw camera_info_topic:=/camera/camera_info

Arguments left empty keep what params_file says.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from launch.actions import DeclareLaunchArgument, OpaqueFunction, SetEnvironmentVariable
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription

# beside launch/ in a checkout and in share/igaussian_ros alike
CONFIGS = Path(__file__).resolve().parents[1] / "msg_configs"
PROFILE = "FASTRTPS_DEFAULT_PROFILES_FILE"

ARGUMENTS = {
    "params_file": (str(CONFIGS / "localizer.yaml"), "parameters of the node"),
    "namespace": ("", "namespace of the node and of relative topic names"),
    "use_sim_time": ("false", "true: time from /clock, for simulators and bags"),
    "map_path": ("", "compiled map (.igmap directory)"),
    "image_topic": ("", "sensor_msgs/Image or CompressedImage"),
    "camera_info_topic": ("", "sensor_msgs/CameraInfo"),
    "image_transport": ("", "raw or compressed"),
    "odom_topic": ("", "nav_msgs/Odometry, if any"),
    "publish_tf": ("", "true: publish /tf"),
}
OVERRIDES = ("map_path", "image_topic", "camera_info_topic", "image_transport", "odom_topic")


def generate_launch_description() -> LaunchDescription:
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=_actions)])


def _actions(context: LaunchContext) -> list[Any]:
    value = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    overrides: dict[str, Any] = {name: value[name] for name in OVERRIDES if value[name]}
    for name in ("use_sim_time", "publish_tf"):
        if value[name]:
            overrides[name] = value[name].lower() == "true"
    node = Node(
        package="igaussian_ros",
        executable="localizer",
        name="localizer",
        namespace=value["namespace"],
        parameters=[value["params_file"], overrides],
        output="screen",
        emulate_tty=True,
    )
    if PROFILE in os.environ:
        return [node]
    # Fast DDS loses most raw images otherwise; the camera's process needs the same profile
    return [SetEnvironmentVariable(PROFILE, str(CONFIGS / "fastdds_large_images.xml")), node]
