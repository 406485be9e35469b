"""The configuration files name what the node really has."""

from __future__ import annotations

import json
import runpy
import sys
import types
from xml.etree import ElementTree

import pytest
from ruamel.yaml import YAML

from igaussian_core.result import Status
from igaussian_ros.diagnostics import OUTCOMES
from igaussian_ros.parameters import ROS_OPTIONS, all_options

OUTPUTS = {
    "/localizer/pose", "/localizer/pose_with_covariance", "/localizer/status",
    "/localizer/debug/overlay", "/diagnostics", "/ground_truth/pose", "initialpose",
}  # fmt: skip


def test_the_transport_profile_holds_a_raw_image(repo_root):
    root = ElementTree.parse(repo_root / "msg_configs" / "fastdds_large_images.xml").getroot()
    space = {"d": "http://www.eprosima.com"}
    segment = int(root.findtext(".//d:segment_size", namespaces=space))
    largest = int(root.findtext(".//d:maxMessageSize", namespaces=space))
    assert 640 * 480 * 3 < largest < segment
    described = {e.text for e in root.iterfind(".//d:transport_descriptor/d:transport_id", space)}
    used = {e.text for e in root.iterfind(".//d:userTransports/d:transport_id", space)}
    assert described == used
    assert root.find("d:participant", space).get("is_default_profile") == "true"


def test_rviz_shows_topics_of_the_node(repo_root):
    config = YAML(typ="safe").load(repo_root / "msg_configs" / "localizer.rviz")
    manager = config["Visualization Manager"]
    shown = [*manager["Displays"], *manager["Tools"]]
    topics = {item["Topic"]["Value"] for item in shown if "Topic" in item}
    assert topics and topics <= OUTPUTS
    assert manager["Global Options"]["Fixed Frame"] == all_options()["map_frame"].default


def test_foxglove_shows_topics_of_the_node(repo_root):
    layout = json.loads((repo_root / "msg_configs" / "foxglove.json").read_text())
    panels = layout["configById"]
    topics = set(panels["3D!map"]["topics"])
    topics.add(panels["Image!overlay"]["imageMode"]["imageTopic"])
    topics.add(panels["RawMessages!status"]["topicPath"])
    topics.add(panels["DiagnosticSummary!all"]["topicToRender"])
    topics |= {path["value"].split(".")[0] for path in panels["Plot!position"]["paths"]}
    assert topics <= OUTPUTS
    placed = []

    def walk(part):
        for side in (part["first"], part["second"]):
            placed.append(side) if isinstance(side, str) else walk(side)

    walk(layout["layout"])
    assert sorted(placed) == sorted(panels)


@pytest.fixture
def launch_file(repo_root, monkeypatch):
    """The launch file's namespace, with the names it takes from launch recorded as calls."""

    class Recorded:
        def __init__(self, *args, **kwargs):
            self.args, self.kwargs = args, kwargs

        def perform(self, context):
            return context[self.args[0]]

    names = {
        "launch": ["LaunchContext", "LaunchDescription"],
        "launch.actions": ["DeclareLaunchArgument", "OpaqueFunction", "SetEnvironmentVariable"],
        "launch.substitutions": ["LaunchConfiguration"],
        "launch_ros": [],
        "launch_ros.actions": ["Node"],
    }
    for module, members in names.items():
        stub = types.ModuleType(module)
        for member in members:
            setattr(stub, member, type(member, (Recorded,), {}))
        monkeypatch.setitem(sys.modules, module, stub)
    return runpy.run_path(str(repo_root / "launch" / "localizer.launch.py"))


def _actions(launch_file, **given):
    (description,) = launch_file["generate_launch_description"]().args
    declared = {a.args[0]: a.kwargs["default_value"] for a in description[:-1]}
    assert set(given) <= set(declared)
    return description[-1].kwargs["function"]({**declared, **given})


def test_the_launch_file_starts_the_node_with_its_file(launch_file, monkeypatch, repo_root):
    monkeypatch.delenv("FASTRTPS_DEFAULT_PROFILES_FILE", raising=False)
    profile, node = _actions(launch_file, map_path="room.igmap", use_sim_time="true")
    assert (node.kwargs["package"], node.kwargs["executable"]) == ("igaussian_ros", "localizer")
    file, overrides = node.kwargs["parameters"]
    assert file == str(repo_root / "msg_configs" / "localizer.yaml")
    assert overrides == {"map_path": "room.igmap", "use_sim_time": True}
    assert profile.args[1] == str(repo_root / "msg_configs" / "fastdds_large_images.xml")


def test_the_launch_file_passes_only_parameters_that_exist(launch_file, monkeypatch):
    monkeypatch.setenv("FASTRTPS_DEFAULT_PROFILES_FILE", "mine.xml")
    everything = {name: "x" for name in launch_file["OVERRIDES"]}
    (node,) = _actions(launch_file, publish_tf="true", **everything)
    overrides = node.kwargs["parameters"][1]
    assert set(overrides) - {"use_sim_time"} <= set(all_options())
    assert overrides["publish_tf"] is True


def test_the_documentation_lists_ros_parameters_with_their_defaults(repo_root):
    text = (repo_root / "docs" / "ros.md").read_text()
    for name, option in ROS_OPTIONS.items():
        value = json.dumps(option.default) if option.default in ("", [], False) else option.default
        assert f"| `{name}` | `{value}` |" in text, name
    for outcome in OUTCOMES:
        assert f"_{outcome}`" in text or f"`{outcome}`" in text, outcome
    for status in Status:
        assert f"`{status.value}`" in text, status
