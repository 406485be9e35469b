"""Parameters come from the core's options; bad values are refused with one clear line."""

from __future__ import annotations

import numpy as np
import pytest
import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter
from ruamel.yaml import YAML

from igaussian_core.config import Config, options
from igaussian_core.errors import ConfigError
from igaussian_ros import parameters


@pytest.fixture
def declared(ros):
    """Makes a node with the given parameters, all of ours declared."""
    nodes = []

    def make(**given):
        overrides = [Parameter(n.replace("__", "."), value=v) for n, v in given.items()]
        node = Node("parameters_test", parameter_overrides=overrides)
        nodes.append(node)
        return node, parameters.declare(node)

    yield make
    for node in nodes:
        node.destroy_node()


def _flat(tree, prefix=""):
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def test_the_parameter_file_lists_every_parameter_with_its_default(repo_root):
    text = (repo_root / "msg_configs" / "localizer.yaml").read_text()
    listed = dict(_flat(YAML(typ="safe").load(text)["/**"]["ros__parameters"]))
    assert listed == {name: option.default for name, option in parameters.all_options().items()}
    assert {n: type(v) for n, v in listed.items()} == {
        name: option.type for name, option in parameters.all_options().items()
    }
    assert text == parameters.to_yaml(), "python -m igaussian_ros.parameters writes it anew"


def test_every_option_of_the_core_is_a_parameter_with_description_and_range(declared):
    node, settings = declared()
    assert settings.config == Config()
    for name, option in options().items():
        descriptor = node.describe_parameter(name)
        assert descriptor.description == option.help
        assert node.get_parameter(name).value == option.default
        for ranges in (descriptor.integer_range, descriptor.floating_point_range):
            for bound in ranges:
                assert (bound.from_value, bound.to_value) == (option.low, option.high)
        if option.low is not None:
            assert descriptor.integer_range or descriptor.floating_point_range
        if option.choices:
            assert ", ".join(option.choices) in descriptor.additional_constraints


def test_values_given_at_start_reach_the_config(declared):
    node, settings = declared(runtime__threads=3, tracking__enabled=False, map_frame="hall")
    assert (settings.config.runtime.threads, settings.config.tracking.enabled) == (3, False)
    assert settings["map_frame"] == "hall"
    assert node.get_parameter("runtime.threads").value == 3


def test_an_integer_serves_where_a_float_is_meant(declared):
    _, settings = declared(tracking__max_gap_s=3, max_rate_hz=5)
    assert settings.config.tracking.max_gap_s == 3.0
    assert type(settings["max_rate_hz"]) is float


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"runtime__threads": 999}, r"runtime.threads=999 is outside \[1, 256\]"),
        ({"runtime__threads": 2.5}, "runtime.threads must be of type int, got float 2.5"),
        ({"runtime__threads": True}, "runtime.threads must be of type int"),
        ({"image_transport": "h264"}, "'h264' is none of raw, compressed"),
        ({"map_path": 5}, "map_path must be of type str"),
        ({"map_frame": ""}, "map_frame must not be empty"),
        ({"max_rate_hz": -1.0}, r"max_rate_hz=-1.0 is outside \[0, 1000\]"),
        ({"base_to_camera": [1.0, 2.0]}, "base_to_camera: expected 7 numbers"),
        ({"base_to_camera": [0.0] * 7}, "base_to_camera: quaternion"),
        ({"base_to_camera": "0 0 0"}, "base_to_camera must be a list of numbers"),
    ],
)
def test_a_bad_value_at_start_is_refused_in_one_line(declared, given, text):
    with pytest.raises(ConfigError, match=text) as caught:
        declared(**given)
    assert "\n" not in str(caught.value)


def test_base_to_camera_is_a_transform_or_nothing(declared):
    assert declared()[1].T_base_cam is None
    T = declared(base_to_camera=[0.1, 0.2, 0.3, -0.5, 0.5, -0.5, 0.5])[1].T_base_cam
    np.testing.assert_allclose(T[:3, 3], [0.1, 0.2, 0.3])
    np.testing.assert_allclose(T[:3, 2], [1, 0, 0], atol=1e-12)
    T = declared(base_to_camera=[0, 0, 1, 0, 0, 0, 1])[1].T_base_cam
    np.testing.assert_allclose(T[:3, 3], [0, 0, 1])


def test_read_only_parameters_cannot_be_changed_at_run_time(declared):
    node, _ = declared()
    for name, value in (("runtime.threads", 3), ("map_frame", "x"), ("publish_tf", True)):
        result = node.set_parameters([Parameter(name, value=value)])[0]
        assert not result.successful
        assert "read-only" in result.reason and name in result.reason


def test_changeable_parameters_are_checked(declared):
    node, _ = declared(map_path="a.igmap")
    assert node.set_parameters([Parameter("map_path", value="b.igmap")])[0].successful
    assert node.set_parameters([Parameter("max_rate_hz", value=4.0)])[0].successful
    empty = node.set_parameters([Parameter("map_path", value="")])[0]
    assert (empty.successful, empty.reason) == (False, "map_path must not be empty")
    high = node.set_parameters([Parameter("max_rate_hz", value=1e6)])[0]
    assert not high.successful and high.reason
    assert node.get_parameter("map_path").value == "b.igmap"


def test_a_mistyped_name_is_pointed_out(declared):
    node, _ = declared(runtime__thread=2, use_sim_time=False)
    assert parameters.unknown_parameters(node) == [
        "parameter 'runtime.thread' is unknown and ignored; did you mean 'runtime.threads'?"
    ]


def test_the_yaml_file_is_read_by_ros(repo_root):
    context = rclpy.Context()
    file = str(repo_root / "msg_configs" / "localizer.yaml")
    rclpy.init(args=["--ros-args", "--params-file", file], context=context)
    node = Node("localizer", context=context, namespace="robot")
    try:
        settings = parameters.declare(node)
        assert settings.config == Config() and settings.T_base_cam is None
        assert parameters.unknown_parameters(node) == []
    finally:
        node.destroy_node()
        context.try_shutdown()
