"""The node's parameters: the core's options under their own names, and those of ROS.

Defaults, descriptions and ranges of the core's options come from `igaussian_core.config`;
those that only ROS has are in `ROS_OPTIONS`.
"""

from __future__ import annotations

import difflib
import json
import textwrap
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    ParameterType,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from igaussian_core.config import Config, Option, options
from igaussian_core.errors import ConfigError
from igaussian_ros.convert import MessageError, transform_from_numbers

# parameters that may change at run time; the rest is fixed at start
CHANGEABLE = ("map_path", "max_rate_hz")
# parameters that rclpy itself declares or reads
_BY_RCLPY = ("use_sim_time", "start_type_description_service", "qos_overrides.")
_LARGEST_INT = 2**62
_TYPES = {
    bool: ParameterType.PARAMETER_BOOL,
    int: ParameterType.PARAMETER_INTEGER,
    float: ParameterType.PARAMETER_DOUBLE,
    str: ParameterType.PARAMETER_STRING,
    list: ParameterType.PARAMETER_DOUBLE_ARRAY,
}


def _text(default: str, help: str, *choices: str) -> Option:
    return Option(str, default, help, None, None, choices)


ROS_OPTIONS: dict[str, Option] = {
    "map_path": _text("", "compiled map (.igmap directory); ~/load_map opens a changed one"),
    "image_topic": _text("/camera/image_raw", "images; with image_transport compressed, "
                         "/compressed is appended where it is missing"),
    "camera_info_topic": _text("/camera/camera_info", "calibration of these images"),
    "image_transport": _text("raw", "sensor_msgs/Image or sensor_msgs/CompressedImage",
                             "raw", "compressed"),
    "image_qos": _text("sensor_data", "QoS of image, camera_info and odometry subscriptions: "
                       "sensor_data (best effort) hears every publisher, reliable only reliable "
                       "ones", "sensor_data", "reliable"),
    "rectified": Option(bool, False, "the images are rectified (image_rect*): camera_info's P "
                        "holds, and D no more", None, None, ()),
    "map_frame": _text("map", "frame of the map and of every published pose"),
    "odom_frame": _text("odom", "frame of the odometry, child of map_frame in /tf"),
    "base_frame": _text("base_link", "the robot's frame; published where base_to_camera is given"),
    "camera_optical_frame": _text("", "the camera's optical frame; empty: from the images"),
    "base_to_camera": Option(list, [], "pose of the camera's optical frame in base_frame: "
                             "[x, y, z, qx, qy, qz, qw], all with a decimal point; empty: the "
                             "optical frame's own pose is published", None, None, ()),
    "odom_topic": _text("", "nav_msgs/Odometry that predicts the motion between frames; "
                        "empty: none"),
    "publish_tf": Option(bool, False, "publish /tf: map->odom with odometry, else map->base, "
                         "else map->camera", None, None, ()),
    "max_rate_hz": Option(float, 0.0, "most frames localized a second; 0: as many as it can",
                          0, 1000, ()),
    "no_data_warning_s": Option(float, 5.0, "seconds without an image after which the node warns",
                                0.5, 3600, ()),
    "overlay_mode": _text("split", "what ~/debug/overlay shows: live left and render right of the "
                          "middle, both blended, or both whole side by side",
                          "split", "blend", "side"),
}  # fmt: skip


@dataclass(frozen=True)
class Settings:
    """The parameters as the node uses them; `values` holds every one under its own name."""

    values: dict[str, Any]
    config: Config
    T_base_cam: NDArray[np.float64] | None

    def __getitem__(self, name: str) -> Any:
        return self.values[name]


def all_options() -> dict[str, Option]:
    """Every parameter by its name, those of ROS first."""
    return {**ROS_OPTIONS, **options()}


def declare(node: Node) -> Settings:
    """Declare every parameter with the values given at start, checked.

    Raises:
        ConfigError: a wrong type, a value out of range or none of the choices.
    """
    values = {}
    for name, option in all_options().items():
        values[name] = checked(name, _given(node, name), option)
        _declare(node, name, values[name], option)
    node.add_on_set_parameters_callback(_on_set)
    return settings_from(values)


def settings_from(values: dict[str, Any]) -> Settings:
    """Settings of checked values.

    Raises:
        ConfigError: frames, topics or a transform that make no sense.
    """
    for name in ("image_topic", "camera_info_topic", "map_frame", "odom_frame", "base_frame"):
        if not values[name]:
            raise ConfigError(f"parameter {name} must not be empty")
    T_base_cam = None
    if values["base_to_camera"]:
        try:
            T_base_cam = transform_from_numbers(values["base_to_camera"])
        except MessageError as error:
            raise ConfigError(f"parameter base_to_camera: {error}") from error
    config = Config.from_flat({name: values[name] for name in options()})
    return Settings(values, config, T_base_cam)


def checked(name: str, value: Any, option: Option) -> Any:
    """The value in the option's own type; the default for None.

    Raises:
        ConfigError: a wrong type, a value out of range or none of the choices.
    """
    if value is None:
        return option.default
    if option.type is list:
        value = [float(x) if type(x) is int else x for x in value] if _is_array(value) else value
        if not isinstance(value, list) or not all(type(x) is float for x in value):
            raise ConfigError(f"parameter {name} must be a list of numbers, got {value!r}")
        return value
    if option.type is float and type(value) is int:
        value = float(value)  # `2` in a YAML file is an integer, and meant as 2.0
    if type(value) is not option.type:
        raise ConfigError(
            f"parameter {name} must be of type {option.type.__name__}, "
            f"got {type(value).__name__} {value!r}"
        )
    if option.choices and value not in option.choices:
        raise ConfigError(f"parameter {name}='{value}' is none of {', '.join(option.choices)}")
    low, high = _bounds(option)
    if isinstance(value, (int, float)) and not low <= value <= high:
        raise ConfigError(f"parameter {name}={value} is outside [{low:g}, {high:g}]")
    return value


def unknown_parameters(node: Node) -> list[str]:
    """One line for each parameter given at start that the node does not have."""
    given: Iterable[str] = getattr(node, "_parameter_overrides", {})
    known = all_options()
    lines = []
    for name in given:
        if name in known or name.startswith(_BY_RCLPY):
            continue
        close = difflib.get_close_matches(name, known, 1)
        hint = f"; did you mean '{close[0]}'?" if close else ""
        lines.append(f"parameter '{name}' is unknown and ignored{hint}")
    return lines


def to_yaml() -> str:
    """The parameter file with every default, `msg_configs/localizer.yaml`."""
    lines = [
        "# Parameters of the node `localizer` with their defaults. Written by",
        "#   python -m igaussian_ros.parameters > msg_configs/localizer.yaml",
        "# Used by",
        "#   ros2 run igaussian_ros localizer --ros-args -p map_path:=room.igmap \\",
        "#     --params-file msg_configs/localizer.yaml",
        "/**:",
        "  ros__parameters:",
    ]
    group = ""
    for name, option in all_options().items():
        prefix, _, key = name.rpartition(".")
        indent = "      " if prefix else "    "
        if prefix and prefix != group:
            lines.append(f"    {prefix}:")
            group = prefix
        lines += [f"{indent}# {line}" for line in _comment(option, 100 - len(indent) - 2)]
        lines.append(f"{indent}{key}: {_yaml_value(option.default)}")
    return "\n".join(lines) + "\n"


def _comment(option: Option, width: int) -> list[str]:
    text = option.help
    if option.choices:
        text += f" [{' | '.join(option.choices)}]"
    elif option.low is not None:
        text += f" [{option.low:g} to {_bounds(option)[1]:g}]"
    return textwrap.wrap(text, width)


def _yaml_value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return json.dumps(value) if isinstance(value, (str, list)) else repr(value)


def _given(node: Node, name: str) -> Any:
    """The value given at start in whatever type, None where there is none.

    A statically typed declaration would refuse 2 for 2.0 and an empty list.
    """
    value = node.declare_parameter(name, None, ParameterDescriptor(dynamic_typing=True)).value
    node.undeclare_parameter(name)
    return value


def _declare(node: Node, name: str, value: Any, option: Option) -> None:
    descriptor = descriptor_of(name, option)
    # an empty list says nothing of its type: declared by type, the value stays unset
    default = Parameter.Type.DOUBLE_ARRAY if option.type is list and not value else value
    node.declare_parameter(name, default, descriptor, ignore_override=True)


def descriptor_of(name: str, option: Option) -> ParameterDescriptor:
    """What `ros2 param describe` shows."""
    descriptor = ParameterDescriptor(
        name=name,
        type=_TYPES[option.type],
        description=option.help,
        read_only=name not in CHANGEABLE,
    )
    if option.choices:
        descriptor.additional_constraints = "one of: " + ", ".join(option.choices)
    low, high = _bounds(option)
    if option.low is not None and option.type is int:
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=1)]
    elif option.low is not None and option.type is float:
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(low), to_value=float(high))
        ]
    return descriptor


def _bounds(option: Option) -> tuple[float, float]:
    low = -_LARGEST_INT if option.low is None else option.low
    return low, _LARGEST_INT if option.high is None else option.high


def _on_set(parameters: list[Parameter]) -> SetParametersResult:
    """Refuse a change that the node could not act on; rclpy refuses the read-only ones."""
    known = all_options()
    for parameter in parameters:
        if parameter.name not in known:
            continue
        try:
            value = checked(parameter.name, parameter.value, known[parameter.name])
        except ConfigError as error:
            return SetParametersResult(successful=False, reason=str(error))
        if parameter.name == "map_path" and not value:
            return SetParametersResult(successful=False, reason="map_path must not be empty")
    return SetParametersResult(successful=True)


def _is_array(value: Any) -> bool:
    return not isinstance(value, (str, bytes)) and hasattr(value, "__iter__")


if __name__ == "__main__":
    print(to_yaml(), end="")
