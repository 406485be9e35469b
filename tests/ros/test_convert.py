"""Known poses, known pixels: a mistake of axes or order shows here."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, Quaternion
from hypothesis import given
from hypothesis import strategies as st
from scene import header, info_message, jpeg_message
from sensor_msgs.msg import CompressedImage, Image

from igaussian_core.errors import CameraError, ImageError
from igaussian_core.geometry import compose, inverse, rotation_from_vector
from igaussian_ros import convert
from igaussian_ros.convert import MessageError

HALF = np.sqrt(0.5)


def test_stamps_keep_every_nanosecond():
    assert convert.stamp_to_ns(Time(sec=1700000000, nanosec=123456789)) == 1700000000123456789
    stamp = convert.stamp_from_ns(1700000000123456789)
    assert (stamp.sec, stamp.nanosec) == (1700000000, 123456789)


@pytest.mark.parametrize(
    ("axis", "expected_xyzw"),
    [
        ([1, 0, 0], (HALF, 0, 0, HALF)),
        ([0, 1, 0], (0, HALF, 0, HALF)),
        ([0, 0, 1], (0, 0, HALF, HALF)),
    ],
)
def test_a_quarter_turn_about_each_axis_becomes_xyzw(axis, expected_xyzw):
    R = rotation_from_vector(np.array(axis) * np.pi / 2)
    q = convert.quaternion_to_ros(R)
    np.testing.assert_allclose([q.x, q.y, q.z, q.w], expected_xyzw, atol=1e-12)
    np.testing.assert_allclose(convert.rotation_from_ros(q), R, atol=1e-12)


def test_an_optical_frame_looking_along_the_maps_x_axis():
    # optical z (forward) along map x, optical x (right) along map -y, optical y (down) along -z
    R = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0.0]])
    pose = convert.pose_to_ros(compose(R, [1, 2, 3]))
    q = pose.orientation
    # the usual optical rotation of URDF files: rpy = -90, 0, -90 degrees
    np.testing.assert_allclose([q.x, q.y, q.z, q.w], [-0.5, 0.5, -0.5, 0.5], atol=1e-12)
    assert (pose.position.x, pose.position.y, pose.position.z) == (1, 2, 3)
    np.testing.assert_allclose(convert.pose_from_ros(pose), compose(R, [1, 2, 3]), atol=1e-12)


def test_base_to_camera_numbers_are_the_cameras_pose_in_the_base():
    T_base_cam = convert.transform_from_numbers([0.2, 0.0, 0.3, -0.5, 0.5, -0.5, 0.5])
    # a point 2 m before the lens is 2.2 m ahead of the base and 0.3 m above it
    np.testing.assert_allclose(T_base_cam @ [0, 0, 2, 1], [2.2, 0, 0.3, 1], atol=1e-12)
    # a point 1 m to the right in the image is on the base's right, which is -y
    np.testing.assert_allclose(T_base_cam @ [1, 0, 0, 1], [0.2, -1, 0.3, 1], atol=1e-12)


def test_the_base_stands_behind_and_below_its_camera():
    T_base_cam = convert.transform_from_numbers([0.2, 0.0, 0.3, -0.5, 0.5, -0.5, 0.5])
    # the robot at (5, 6, 0) heading along map y
    T_map_base = compose(rotation_from_vector([0, 0, np.pi / 2]), [5, 6, 0])
    T_map_cam = T_map_base @ T_base_cam
    np.testing.assert_allclose(T_map_cam[:3, 3], [5, 6.2, 0.3], atol=1e-12)
    np.testing.assert_allclose(T_map_cam[:3, 2], [0, 1, 0], atol=1e-12)  # looks along map y
    found = convert.base_from_camera(T_map_cam, T_base_cam)
    np.testing.assert_allclose(found, T_map_base, atol=1e-12)


def test_a_transform_message_says_parent_child_and_the_childs_place():
    T = compose(rotation_from_vector([0, 0, np.pi / 2]), [1, 2, 3])
    message = convert.transform_to_ros(T, header(5, "map"), "odom")
    assert (message.header.frame_id, message.child_frame_id) == ("map", "odom")
    t, q = message.transform.translation, message.transform.rotation
    assert (t.x, t.y, t.z) == (1, 2, 3)
    np.testing.assert_allclose([q.x, q.y, q.z, q.w], [0, 0, HALF, HALF], atol=1e-12)


@given(st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(-100, 100)] * 3))
def test_poses_survive_the_way_there_and_back(rotvec, translation):
    T = compose(rotation_from_vector(rotvec), translation)
    np.testing.assert_allclose(convert.pose_from_ros(convert.pose_to_ros(T)), T, atol=1e-9)


@pytest.mark.parametrize(
    "xyzw", [(0, 0, 0, 0), (0, 0, 0, 2), (float("nan"), 0, 0, 1), (0.5, 0.5, 0.5, 0)]
)
def test_no_unit_quaternion_is_refused(xyzw):
    x, y, z, w = (float(value) for value in xyzw)
    with pytest.raises(MessageError, match="quaternion"):
        convert.pose_from_ros(Pose(orientation=Quaternion(x=x, y=y, z=z, w=w)))


def test_numbers_that_are_no_transform_are_refused():
    with pytest.raises(MessageError, match="7 numbers"):
        convert.transform_from_numbers([0.0] * 6)
    with pytest.raises(MessageError, match="not finite"):
        convert.transform_from_numbers([np.inf, 0, 0, 0, 0, 0, 1])


def test_pose_with_covariance_keeps_the_order_of_ros():
    covariance = np.diag([1.0, 2, 3, 4, 5, 6])
    covariance[0, 5] = covariance[5, 0] = 0.5
    message = convert.pose_with_covariance(np.eye(4), covariance, header(1, "map"))
    values = np.array(message.pose.covariance).reshape(6, 6)
    np.testing.assert_array_equal(values, covariance)


def test_the_covariance_of_a_base_one_metre_behind_its_camera():
    # only yaw is uncertain, by 0.1 rad: the base then swings sideways by 0.1 m
    covariance = np.zeros((6, 6))
    covariance[5, 5] = 0.01
    T_map_base = compose(np.eye(3), [-1, 0, 0])
    moved = convert.moved_covariance(covariance, np.eye(4), T_map_base)
    np.testing.assert_allclose(np.diag(moved), [0, 0.01, 0, 0, 0, 0.01], atol=1e-12)
    np.testing.assert_allclose(moved[1, 5], -0.01, atol=1e-12)


def test_moved_covariance_agrees_with_sampled_poses():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 6)) * 0.003
    covariance = A @ A.T
    T_map_cam = compose(rotation_from_vector([0.3, -0.2, 0.9]), [1, 2, 3])
    T_base_cam = compose(rotation_from_vector([0.1, 0.4, -0.2]), [0.5, 0.1, 0.8])
    T_map_base = T_map_cam @ inverse(T_base_cam)
    samples = []
    for delta in rng.multivariate_normal(np.zeros(6), covariance, 4000):
        turned = rotation_from_vector(delta[3:])
        moved = compose(turned @ T_map_cam[:3, :3], T_map_cam[:3, 3] + delta[:3])
        base = moved @ inverse(T_base_cam)
        samples.append([*(base[:3, 3] - T_map_base[:3, 3]), *delta[3:]])
    expected = convert.moved_covariance(covariance, T_map_cam, T_map_base)
    np.testing.assert_allclose(np.cov(np.array(samples).T), expected, atol=expected.max() * 0.06)


# --- images: every encoding, rows padded ---

RGB = np.array(
    [[[250, 10, 20], [30, 240, 40], [10, 20, 230], [200, 200, 200]],
     [[90, 60, 30], [0, 0, 0], [255, 255, 255], [128, 64, 32]]], np.uint8
)  # fmt: skip
PAD = 5


def _message(encoding: str, rows: np.ndarray, bigendian: bool = False) -> Image:
    """Image of pixel rows [H, bytes], each followed by PAD bytes of rubbish."""
    height = rows.shape[0]
    data = np.full((height, rows.shape[1] + PAD), 77, np.uint8)
    data[:, :-PAD] = rows
    message = Image(header=header(1), height=height, width=RGB.shape[1], encoding=encoding)
    message.step, message.is_bigendian, message.data = data.shape[1], int(bigendian), data.tobytes()
    return message


@pytest.mark.parametrize(
    ("encoding", "code"),
    [("rgb8", None), ("bgr8", cv2.COLOR_RGB2BGR), ("rgba8", cv2.COLOR_RGB2RGBA),
     ("bgra8", cv2.COLOR_RGB2BGRA), ("8UC3", cv2.COLOR_RGB2BGR)],
)  # fmt: skip
def test_colour_encodings_with_padded_rows(encoding, code):
    pixels = RGB if code is None else cv2.cvtColor(RGB, code)
    found = convert.image_from_ros(_message(encoding, pixels.reshape(2, -1)))
    np.testing.assert_array_equal(found, RGB)


@pytest.mark.parametrize("bigendian", [False, True])
def test_mono16_in_both_byte_orders(bigendian):
    grey = np.array([[0, 0x0100, 0x8000, 0xFFFF], [0xFF00, 0x7FFF, 1, 0x4000]], np.uint16)
    rows = grey.astype(">u2" if bigendian else "<u2").view(np.uint8)
    found = convert.image_from_ros(_message("mono16", rows, bigendian))
    np.testing.assert_allclose(found[..., 0], grey / 257.0, atol=0.51)
    np.testing.assert_array_equal(found[..., 0], found[..., 2])


def test_mono8_is_grey_in_all_channels():
    grey = RGB[..., 0]
    found = convert.image_from_ros(_message("mono8", grey))
    np.testing.assert_array_equal(found, np.repeat(grey[..., None], 3, 2))


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_give_the_flat_colour_back(pattern, bits):
    colour = {"r": 200, "g": 120, "b": 40}
    tile = np.array([colour[c] for c in pattern]).reshape(2, 2)
    mosaic = np.tile(tile, (8, 8)).astype(np.uint8)
    rows = mosaic if bits == 8 else (mosaic.astype("<u2") * 257).view(np.uint8)
    message = Image(header=header(1), height=16, width=16, encoding=f"bayer_{pattern}{bits}")
    message.step, message.data = rows.shape[1], rows.tobytes()
    found = convert.image_from_ros(message)
    np.testing.assert_array_equal(found[8, 8], [200, 120, 40])


@pytest.mark.parametrize(
    ("encoding", "order"),
    [("yuv422", "uyvy"), ("uyvy", "uyvy"), ("yuv422_yuy2", "yuyv"), ("yuyv", "yuyv")],
)
def test_yuv422_orders(encoding, order):
    # BT.601, limited range: a strong red
    y, u, v = 81, 90, 240
    pair = {"uyvy": [u, y, v, y], "yuyv": [y, u, y, v]}[order]
    rows = np.tile(np.array(pair, np.uint8), (2, 2))
    found = convert.image_from_ros(_message(encoding, rows))
    np.testing.assert_allclose(found[1, 2], [254, 0, 0], atol=4)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"encoding": "32FC1"}, "32FC1"),
        ({"encoding": ""}, "encoding ''"),
        ({"step": 5}, "step 5"),
        ({"step": 0}, "step 0"),
        ({"height": 3}, "bytes"),
        ({"width": 0}, "not positive"),
        ({"data": b""}, "bytes"),
    ],
)
def test_images_that_cannot_be_used_say_what_is_wrong(change, text):
    message = _message("rgb8", RGB.reshape(2, -1))
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(ImageError, match=text):
        convert.image_from_ros(message)


def test_jpeg_keeps_red_red():
    red = np.zeros((32, 32, 3), np.uint8)
    red[..., 0] = 220
    found = convert.image_from_ros(jpeg_message(1, red))
    np.testing.assert_allclose(found[16, 16], [220, 0, 0], atol=6)


@pytest.mark.parametrize(
    ("format", "data", "text"),
    [("jpeg", b"", "no bytes"), ("jpeg", b"no image at all", "no JPEG"),
     ("16UC1; compressedDepth png", b"\0" * 40, "depth")],
)  # fmt: skip
def test_compressed_images_that_are_none(format, data, text):
    with pytest.raises(ImageError, match=text):
        convert.image_from_ros(CompressedImage(header=header(1), format=format, data=data))


def test_an_image_message_is_rgb8_and_comes_back():
    message = convert.image_to_ros(RGB, header(9))
    assert (message.encoding, message.step, message.is_bigendian) == ("rgb8", 12, 0)
    np.testing.assert_array_equal(convert.image_from_ros(message), RGB)


# --- camera_info ---


def test_camera_info_becomes_the_camera():
    camera = convert.camera_from_ros(info_message(1))
    assert (camera.width, camera.height, camera.fx, camera.cx) == (480, 360, 400.0, 239.5)
    assert camera.is_pinhole


def test_binning_and_region_shift_the_principal_point():
    message = info_message(1)
    message.binning_x = message.binning_y = 2
    message.roi.x_offset, message.roi.y_offset = 80, 40
    message.roi.width, message.roi.height = 320, 240
    camera = convert.camera_from_ros(message)
    assert (camera.width, camera.height, camera.fx, camera.fy) == (160, 120, 200, 200)
    # full pixel 239.5 - 80 = 159.5 lies between the binned pixels 79 and 80
    assert (camera.cx, camera.cy) == (79.5, 69.5)


def test_rectified_images_take_p_and_no_distortion():
    message = info_message(1)
    message.d = [0.3, 0.1, 0.0, 0.0, 0.0]
    message.p = [300.0, 0, 200, 0, 0, 310, 150, 0, 0, 0, 1, 0]
    assert convert.camera_from_ros(message).dist[0] == 0.3
    camera = convert.camera_from_ros(message, rectified=True)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (300, 310, 200, 150)
    assert camera.is_pinhole


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"k": [0.0] * 9}, "zeros"),
        ({"width": 0}, "0x360"),
        ({"distortion_model": "my_lens", "d": [0.1, 0.2]}, "my_lens"),
        ({"d": [0.1, 0.2, 0.3]}, "3"),
        ({"k": [float("nan")] * 9}, "finite"),
    ],
)
def test_camera_infos_that_cannot_be_used_say_what_is_wrong(change, text):
    message = info_message(1)
    for name, value in change.items():
        setattr(message, name, value)
    with pytest.raises(CameraError, match=text):
        convert.camera_from_ros(message)


def test_an_empty_d_is_a_pinhole():
    message = info_message(1)
    message.d = []
    message.distortion_model = ""
    assert convert.camera_from_ros(message).is_pinhole
