"""Odometry at an image's time, and which transform of the map is published."""

from __future__ import annotations

import numpy as np
import pytest
from scene import BASE_TO_CAMERA

from igaussian_core.geometry import compose, rotation_from_vector
from igaussian_ros.convert import transform_from_numbers
from igaussian_ros.tf import Frames, OdometryBuffer, create_tf_publisher, map_transform

FRAMES = Frames("odom", "base_link", "camera")
MS = 1_000_000


def _turned(yaw: float, x: float) -> np.ndarray:
    return compose(rotation_from_vector([0, 0, yaw]), [x, 0, 0])


def test_odometry_is_interpolated_between_its_neighbours():
    buffer = OdometryBuffer()
    buffer.add(1000 * MS, _turned(0.0, 1.0))
    buffer.add(1100 * MS, _turned(0.4, 2.0))
    np.testing.assert_allclose(buffer.at(1025 * MS), _turned(0.1, 1.25), atol=1e-12)
    np.testing.assert_allclose(buffer.at(1100 * MS), _turned(0.4, 2.0), atol=1e-12)


def test_odometry_holds_for_a_moment_and_no_longer():
    buffer = OdometryBuffer(hold_ns=200 * MS)
    assert buffer.at(1000 * MS) is None
    buffer.add(1000 * MS, _turned(0.1, 1.0))
    np.testing.assert_allclose(buffer.at(1150 * MS), _turned(0.1, 1.0))
    np.testing.assert_allclose(buffer.at(850 * MS), _turned(0.1, 1.0))
    assert buffer.at(1250 * MS) is None and buffer.at(750 * MS) is None


def test_a_bag_started_again_empties_the_buffer():
    buffer = OdometryBuffer()
    for i in range(5):
        buffer.add((9000 + i) * MS, _turned(0, 1))
    buffer.add(1000 * MS, _turned(0, 2))
    assert buffer.at(9000 * MS) is None
    np.testing.assert_allclose(buffer.at(1000 * MS), _turned(0, 2))


def test_old_odometry_is_forgotten():
    buffer = OdometryBuffer(keep_ns=1000 * MS, hold_ns=0)
    for i in range(100):
        buffer.add(i * 100 * MS, _turned(0, i))
    assert buffer.at(1000 * MS) is None
    assert buffer.at(9500 * MS)[0, 3] == pytest.approx(95)
    buffer.clear()
    assert buffer.at(9500 * MS) is None


def test_map_to_odom_joins_localization_and_odometry():
    T_map_odom = compose(rotation_from_vector([0, 0, 0.3]), [1, -2, 0])
    T_base_cam = transform_from_numbers(BASE_TO_CAMERA)
    T_odom_cam = _turned(0.5, 4.0) @ T_base_cam
    found = map_transform(T_map_odom @ T_odom_cam, FRAMES, T_base_cam, T_odom_cam)
    assert found.child == "odom"
    np.testing.assert_allclose(found.T_map_child, T_map_odom, atol=1e-12)


def test_without_odometry_the_base_or_the_camera_hangs_below_the_map():
    T_base_cam = transform_from_numbers(BASE_TO_CAMERA)
    T_map_base = _turned(0.5, 4.0)
    found = map_transform(T_map_base @ T_base_cam, FRAMES, T_base_cam, None)
    assert found.child == "base_link"
    np.testing.assert_allclose(found.T_map_child, T_map_base, atol=1e-12)
    found = map_transform(T_map_base, FRAMES, None, None)
    assert found.child == "camera"
    np.testing.assert_array_equal(found.T_map_child, T_map_base)


def test_tf_is_optional(ros):
    import importlib.util

    from rclpy.node import Node

    node = Node("tf_test")
    try:
        publisher = create_tf_publisher(node)
        there = importlib.util.find_spec("tf2_msgs") is not None
        assert (publisher is not None) == there
    finally:
        node.destroy_node()
