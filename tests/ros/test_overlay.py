"""The overlay shows live and render where it says it does."""

from __future__ import annotations

import numpy as np
import pytest

from igaussian_core.result import LocalizationResult, Status
from igaussian_ros import overlay

LIVE = np.full((60, 80, 3), 200, np.uint8)
RENDER = np.full((60, 80, 3), 100, np.uint8)


def test_split_has_the_live_image_left():
    picture = overlay.compare(LIVE, RENDER, "split")
    assert picture.shape == LIVE.shape
    assert (picture[:, :38] == 200).all() and (picture[:, 42:] == 100).all()
    assert (LIVE == 200).all()


@pytest.mark.parametrize(("mode", "width"), [("side", 160), ("blend", 80)])
def test_the_other_modes(mode, width):
    picture = overlay.compare(LIVE, RENDER, mode)
    assert picture.shape == (60, width, 3)
    assert picture[30, 10, 0] == (200 if mode == "side" else 150)
    assert picture[30, width - 10, 0] == (100 if mode == "side" else 150)


def test_without_a_render_the_live_image_stays_whole():
    assert overlay.compare(LIVE, None, "side") is LIVE


def test_the_caption_lies_below_and_says_good_or_bad():
    good = overlay.captioned(LIVE, "text", True)
    bad = overlay.captioned(LIVE, "text", False)
    assert good.shape[0] == bad.shape[0] > 60
    np.testing.assert_array_equal(good[:60], LIVE)
    assert (good[61, 79] != bad[61, 79]).any()
    assert (good[60:, :, 0] > 180).any()  # letters


def test_the_caption_gives_evidence_or_the_reason():
    T = np.eye(4)
    T[:3, 3] = [1.5, -2, 0.25]
    found = LocalizationResult(Status.OK, T_map_cam=T, inliers=80, matches=90, source="prior",
                               residual_px=0.5, timings_ms={"total": 123.4})  # fmt: skip
    text = overlay.caption(found)
    assert "80/90" in text and "1.50 -2.00 0.25" in text and "123 ms" in text
    lost = LocalizationResult(Status.OUT_OF_MAP, "3 % covered")
    assert overlay.caption(lost) == "LOST out_of_map: 3 % covered"


def test_renders_are_clipped_and_rounded():
    rgb = np.array([[[-0.1, 0.5, 1.2]]], np.float32)
    picture = overlay.in_colours_of(LIVE[:1, :1], rgb, np.ones((1, 1), np.float32))
    np.testing.assert_array_equal(picture, [[[0, 128, 255]]])


def test_a_render_is_shown_in_the_exposure_of_the_live_image():
    rgb = np.random.default_rng(0).random((60, 80, 3)).astype(np.float32)
    live = (rgb * 0.5 * 255 + 20).astype(np.uint8)
    picture = overlay.in_colours_of(live, rgb, np.ones((60, 80), np.float32))
    assert np.abs(picture.astype(int) - live).max() <= 2
    other = np.random.default_rng(1).integers(0, 255, LIVE.shape, np.uint8)
    unchanged = overlay.in_colours_of(other, rgb, np.ones((60, 80), np.float32))
    np.testing.assert_array_equal(unchanged, (rgb * 255 + 0.5).astype(np.uint8))
