"""A network's answer, corrected by what the same network says of a render from there.

The network errs alike on images that are alike. Where it takes an image for T_0, a render from T_0
is nearly that image, its pose is known, and what the network says of it, t(T_0), shows how far
the network is off thereabouts:

    T_1 = T_0 t(T_0)^-1 T_0        and again        T_n+1 = T_n t(T_n)^-1 T_0

It is the paper's attention to a source view of known pose, with one that is rendered for the
image. The render is made as training views are, and given the image's exposure, of which the
network would make another error.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.coarse.canonical import OVERSAMPLING
from igaussian_core.geometry import compose, inverse, nearest_rotation, pose_error

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Tell = Callable[[Image], Array]
Render = Callable[[Camera, Array], tuple[NDArray[np.float32], ...]]

_LARGEST_DEG, _LARGEST_LENGTHS = 20.0, 0.4  # a network that is so far off knows nothing here
_BLUR_PX = 3.0  # poses and so pixels are not quite the same
_DARK, _BRIGHT = 12.0, 250.0  # grey levels between which a ratio tells the exposure


def looked_back(
    image: Image, camera: Camera, first: Array, tell: Tell, render: Render, renders: int,
    length: float,
) -> Array:  # fmt: skip
    """The corrected pose T_scene_cam of an image.

    Args:
        image: uint8 RGB [H, W, 3] of the canonical camera.
        camera: that one.
        first: what the network says of it.
        tell: the network's T_scene_cam of such an image.
        render: RGB in [0, 1] and more of the map at a T_scene_cam.
        renders: how often to correct.
        length: of the scene, in its units.
    """
    found = first
    for _ in range(renders):
        told = tell(exposed(_small_render(camera, render, found), image))
        angle, distance = pose_error(told, found)
        if angle > _LARGEST_DEG or distance > _LARGEST_LENGTHS * length:
            break
        T = found @ inverse(told) @ first
        found = compose(nearest_rotation(T[:3, :3]), T[:3, 3])
    return found


def exposed(render: Image, image: Image) -> Image:
    """A render with the image's exposure and white balance: each channel times the median of
    the ratios.

    A gain alone: with an offset besides (`colour.fit_colour`) what a pose is off by passes for
    a change of colours.
    """
    soft_render, soft_image = (
        cv2.GaussianBlur(part, (0, 0), _BLUR_PX).astype(np.float32) for part in (render, image)
    )
    gain = np.ones(3, np.float32)
    usable = (soft_render > _DARK) & (soft_image > _DARK)
    usable &= (soft_render < _BRIGHT) & (soft_image < _BRIGHT)
    for channel in range(3):
        where = usable[..., channel]
        if where.any():
            ratios = soft_image[..., channel][where] / soft_render[..., channel][where]
            gain[channel] = np.median(ratios)
    return np.clip(render * gain + 0.5, 0, 255).astype(np.uint8)


def _small_render(camera: Camera, render: Render, T_scene_cam: Array) -> Image:
    size = camera.width, camera.height
    large = camera.resized(OVERSAMPLING * size[0], OVERSAMPLING * size[1])
    rgb = cv2.resize(render(large, T_scene_cam)[0], size, interpolation=cv2.INTER_AREA)
    return np.asarray(np.clip(rgb, 0, 1) * 255 + 0.5, np.uint8)
