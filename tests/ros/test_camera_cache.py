"""Cameras are found by size and frame, and a bad camera_info spoils nothing."""

from __future__ import annotations

import pytest
from scene import FRAME, info_message

from igaussian_core.errors import CameraError
from igaussian_ros.camera_cache import CameraCache
from igaussian_ros.convert import MessageError


def _info(width: int, height: int, fx: float = 400.0):
    message = info_message(1)
    message.width, message.height = width, height
    message.k[0] = fx
    return message


def test_cameras_of_two_sizes_and_frames_do_not_mix():
    cache = CameraCache()
    cache.update(_info(480, 360, 400), "left")
    cache.update(_info(480, 360, 401), "right")
    cache.update(_info(640, 480, 500), "left")
    assert cache.find(480, 360, "left").fx == 400
    assert cache.find(480, 360, "right").fx == 401
    assert cache.find(640, 480, "left").fx == 500


def test_the_refusal_says_what_is_missing_and_what_there_is():
    cache = CameraCache()
    with pytest.raises(MessageError, match="640x480 in frame 'left'; received: none yet"):
        cache.find(640, 480, "left")
    cache.update(_info(480, 360), "left")
    with pytest.raises(MessageError, match="received: 480x360 in 'left'"):
        cache.find(640, 480, "left")
    with pytest.raises(MessageError, match="frame 'right'"):
        cache.find(480, 360, "right")


def test_an_empty_frame_matches_any():
    cache = CameraCache()
    cache.update(_info(480, 360), FRAME)
    assert cache.find(480, 360, "").fx == 400
    nameless = CameraCache()
    nameless.update(_info(480, 360), "")
    assert nameless.find(480, 360, FRAME).fx == 400


def test_a_bad_camera_info_leaves_the_last_valid_one():
    cache = CameraCache()
    cache.update(_info(480, 360), FRAME)
    bad = _info(480, 360)
    bad.k = [0.0] * 9
    with pytest.raises(CameraError, match="zeros"):
        cache.update(bad, FRAME)
    assert cache.find(480, 360, FRAME).fx == 400
    cache.clear()
    with pytest.raises(MessageError):
        cache.find(480, 360, FRAME)
