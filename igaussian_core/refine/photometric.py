"""Direct alignment of an image with one RGB-D render of nearly the same view.

Inverse-compositional Levenberg-Marquardt (Baker & Matthews 2004): the Jacobian is the render's and
is computed once. Gain and offset of brightness are solved for along with the pose, and Tukey's
weights pass over what the render does not show.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.contrast import blocks
from igaussian_core.geometry import compose, inverse, rotation_from_vector, vector_from_rotation
from igaussian_core.lifting import unproject

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

_CELL = 16  # side of the largest blocks that give a pixel each
_BORDER = 4  # pixels at the image's edge that are left out
_MIN_GRADIENT = 1.5  # grey levels a pixel; flatter places tell noise
_MIN_PIXELS = 200
_TUKEY = 4.685  # in standard deviations: 95 % efficient on normal noise
_LEAST_DEVIATION = 1.0  # grey levels: rounding
_CONVERGED_PX = 0.01
_MAX_DAMPING = 1e3


@dataclass(frozen=True)
class Photometric:
    """The outcome of one alignment.

    Attributes:
        T_render_cam: [4, 4] pose of the image's camera in the render's camera frame.
        before, after: Tukey's mean loss over the finest level's pixels at the start and here
            (grey levels squared), in units of the same deviation, gain and offset fitted.
        gain, offset: image = gain * render + offset, grey levels.
        pixels: of the finest level.
        step_px: largest motion of the image by the last step; inf where none was taken.
    """

    T_render_cam: Array
    before: float
    after: float
    gain: float
    offset: float
    pixels: int
    step_px: float

    @property
    def lowered(self) -> bool:
        """Whether less is left than at the start."""
        return self.after < self.before


@dataclass(frozen=True)
class _Level:
    """Pixels of one resolution of the render, with all that does not change."""

    image: Image
    camera: Camera
    points: Array  # [N, 3] in the render's camera
    brightness: Array  # [N]
    jacobian: Array  # [N, 8] of brightness: the points' translation, rotation; gain, offset

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True)
class _Fit:
    """A pose with gain and offset, and what they leave."""

    T: Array  # T_render_cam
    gain: float
    offset: float
    residual: Array  # [N] image - gain * render - offset
    seen: Mask  # [N] in sight of the image
    deviation: float  # of the residual, robust

    def loss(self, deviation: float) -> float:
        """Tukey's mean loss: squares, levelling off at the limit."""
        limit = _TUKEY * deviation
        inside = np.clip(1 - np.square(self.residual[self.seen] / limit), 0, 1)
        return float(np.mean(limit**2 / 3 * (1 - inside**3)))

    def weights(self) -> Array:
        """Tukey's biweight [N], 0 out of sight."""
        scaled = self.residual / (_TUKEY * self.deviation)
        return np.where(self.seen, np.square(np.maximum(1 - scaled * scaled, 0)), 0.0)


def align_photometric(
    image: Image,
    render: Image,
    depth: Image,
    trusted: Mask,
    camera: Camera,
    T_render_cam: Array | None = None,
    covariance: Array | None = None,
    levels: int = 1,
    pixels: int = 6000,
    iterations: int = 12,
) -> Photometric | None:
    """The pose at which an image shows what a render shows, up to gain and offset.

    Args:
        image, render: grey [H, W] float32, 0 to 255, of one pinhole camera.
        depth: z [H, W] of the render's pixels, any unit.
        trusted: mask [H, W] of pixels whose depth holds.
        camera: of both.
        T_render_cam: where to start; None: at the render's own pose.
        covariance: [6, 6] of the start by other evidence, axes of the render's camera, order
            x y z rx ry rz. Only its shape counts: it is scaled to weigh as much as the pixels,
            so that the result lies between both. None: the pixels alone.
        levels: resolutions, each half of the one before; the coarsest is aligned first.
        pixels: most pixels used of a resolution.
        iterations: most steps at a resolution.

    Returns:
        None where fewer than 200 pixels have texture and depth, or fewer stay in sight.
    """
    T_start = np.eye(4) if T_render_cam is None else np.asarray(T_render_cam, np.float64)
    pyramid = _pyramid(image, render, depth, trusted, camera, levels, pixels)
    finest = pyramid[0]
    start = _fitted(finest, T_start)
    if start is None:
        return None
    T, step_px = T_start, np.inf
    for level in reversed(pyramid):
        fit = start if level is finest and T is T_start else _fitted(level, T)
        if fit is not None:
            fit, step_px = _descended(level, fit, T_start, covariance, iterations)
            T = fit.T
    if fit is None:
        return None
    scale = start.deviation
    return Photometric(
        T, start.loss(scale), fit.loss(scale), fit.gain, fit.offset, len(finest), step_px
    )


def _pyramid(
    image: Image, render: Image, depth: Image, trusted: Mask, camera: Camera,
    levels: int, pixels: int,
) -> list[_Level]:  # fmt: skip
    """Finest first. pyrDown keeps every second pixel: pixel (0, 0) stays where it is."""
    found = []
    for index in range(levels):
        if index > 0:
            image, render = (np.asarray(cv2.pyrDown(i), np.float32) for i in (image, render))
        scale = 1 << index
        view = Camera(
            image.shape[1], image.shape[0], camera.fx / scale, camera.fy / scale,
            camera.cx / scale, camera.cy / scale,
        )  # fmt: skip
        mask, z = trusted[::scale, ::scale], depth[::scale, ::scale]
        found.append(_level(image, render, z, mask, view, pixels))
    return found


def _level(
    image: Image, render: Image, depth: Image, trusted: Mask, camera: Camera, pixels: int
) -> _Level:
    du = cv2.Scharr(render, cv2.CV_32F, 1, 0, scale=1 / 32)
    dv = cv2.Scharr(render, cv2.CV_32F, 0, 1, scale=1 / 32)
    v, u = _steep(du * du + dv * dv, trusted, pixels)
    uv = np.stack([u, v], axis=1).astype(np.float32)
    points, brightness = unproject(camera, uv, depth[v, u]), render[v, u].astype(np.float64)
    x, y, z = points.T
    gx, gy = du[v, u] * camera.fx / z, dv[v, u] * camera.fy / z
    gz = -(gx * x + gy * y) / z
    columns = [gx, gy, gz, y * gz - z * gy, z * gx - x * gz, x * gy - y * gx, brightness]
    return _Level(image, camera, points, brightness, np.stack([*columns, np.ones_like(x)], 1))


def _steep(
    steepness: Image, trusted: Mask, pixels: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns of the steepest trusted pixel of each block, blocks so small that where
    there is texture they are at most `pixels`."""
    usable = np.zeros_like(steepness)
    inner = np.s_[_BORDER:-_BORDER, _BORDER:-_BORDER]
    usable[inner] = np.where(trusted[inner], steepness[inner], 0)
    textured = (blocks(usable, _CELL).max(axis=1, initial=0) > _MIN_GRADIENT**2).sum()
    side = int(np.clip(np.ceil((textured * _CELL**2 / pixels) ** 0.5), 1, _CELL))
    cells = blocks(usable, side)
    inside = cells.argmax(axis=1)
    block = np.flatnonzero(cells[np.arange(len(cells)), inside] > _MIN_GRADIENT**2)
    inside, columns = inside[block], usable.shape[1] // side
    return block // columns * side + inside // side, block % columns * side + inside % side


def _fitted(level: _Level, T: Array) -> _Fit | None:
    """Robust gain and offset at a pose; None where too little is in sight."""
    brightness, seen = _sampled(level, T)
    if seen.sum() < _MIN_PIXELS:
        return None
    gain, offset = 1.0, float(np.median((brightness - level.brightness)[seen]))
    for _ in range(5):
        fit = _fit(level, T, gain, offset, brightness, seen)
        weight = fit.weights()
        total = max(float(weight.sum()), 1e-9)
        mean_x, mean_y = weight @ level.brightness / total, weight @ brightness / total
        x, y = level.brightness - mean_x, brightness - mean_y
        gain = float(np.clip(weight @ (x * y) / max(float(weight @ (x * x)), 1e-9), 0.1, 10))
        offset = float(mean_y - gain * mean_x)
    return _fit(level, T, gain, offset, brightness, seen)


def _fit(
    level: _Level, T: Array, gain: float, offset: float, brightness: Array, seen: Mask
) -> _Fit:
    residual = brightness - gain * level.brightness - offset
    # standard deviation of normal residuals, from their median magnitude
    deviation = 1.4826 * float(np.median(np.abs(residual[seen])))
    return _Fit(T, gain, offset, residual, seen, max(deviation, _LEAST_DEVIATION))


def _sampled(level: _Level, T_render_cam: Array) -> tuple[Array, Mask]:
    """The image's brightness [N] where the points are at a pose, and which are in sight."""
    rotation, position = T_render_cam[:3, :3], T_render_cam[:3, 3]
    x, y, z = ((level.points - position) @ rotation).T
    camera, ahead = level.camera, z > 1e-9
    z = np.where(ahead, z, 1.0)
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    seen = ahead & (u >= 0) & (v >= 0) & (u <= camera.width - 1) & (v <= camera.height - 1)
    return _bilinear(level.image, np.where(seen, u, 0.0), np.where(seen, v, 0.0)), seen


def _bilinear(image: Image, u: Array, v: Array) -> Array:
    """Samples [N]; unlike cv2.remap's, their places are not rounded to 1/32 pixel."""
    height, width = image.shape
    column = np.minimum(u.astype(np.intp), width - 2)
    row = np.minimum(v.astype(np.intp), height - 2)
    du, dv = u - column, v - row
    flat, index = image.reshape(-1), row * width + column
    top = flat[index] * (1 - du) + flat[index + 1] * du
    low = flat[index + width] * (1 - du) + flat[index + width + 1] * du
    return np.asarray(top * (1 - dv) + low * dv)


def _descended(
    level: _Level, fit: _Fit, T_start: Array, covariance: Array | None, iterations: int
) -> tuple[_Fit, float]:
    """The best fit that steps from `fit` reach, and the last step in pixels."""
    information = _information(level, fit, covariance)
    to_px = level.camera.fx * np.array([1 / float(np.median(level.points[:, 2]))] * 3 + [1.0] * 3)
    damping, step_px = 1e-4, float("inf")
    for _ in range(iterations):
        off = _offset(fit.T, T_start)
        step = _step(level, fit, information, off, damping)
        T = compose(rotation_from_vector(step[3:6]), step[:3]) @ fit.T
        brightness, seen = _sampled(level, T)
        if seen.sum() < _MIN_PIXELS:
            break
        gain, offset = fit.gain + step[6], fit.offset + step[7]
        new = _fit(level, T, gain, offset, brightness, seen)
        off_new = _offset(T, T_start)
        pull = (off_new @ information @ off_new - off @ information @ off) / seen.sum()
        if new.loss(fit.deviation) + pull >= fit.loss(fit.deviation):
            damping *= 100
            if damping > _MAX_DAMPING:
                break
            continue
        fit, damping = new, max(damping / 10, 1e-7)
        step_px = float(np.abs(step[:6] * to_px).max())
        if step_px < _CONVERGED_PX:
            break
    return fit, step_px


def _information(level: _Level, fit: _Fit, covariance: Array | None) -> Array:
    """The start's information [6, 6], scaled to weigh as much as the pixels' on average."""
    if covariance is None:
        return np.zeros((6, 6))
    J = fit.gain * level.jacobian[:, :6]
    pixels = (J * fit.weights()[:, None]).T @ J
    information = np.linalg.inv(covariance)
    share = np.trace(information @ np.linalg.pinv(pixels, hermitian=True)) / 6
    return np.asarray(information / max(float(share), 1e-30))


def _offset(T_render_cam: Array, T_start: Array) -> Array:
    """Translation and rotation vector [6] from the start, axes of the render's camera."""
    moved = T_render_cam @ inverse(T_start)
    return np.concatenate([moved[:3, 3], vector_from_rotation(moved[:3, :3])])


def _step(
    level: _Level, fit: _Fit, information: Array, off: Array, damping: float
) -> Array:
    """By what the points move in the render, and gain and offset change, [8]."""
    chain = np.array([fit.gain] * 6 + [1.0, 1.0])
    weighted = level.jacobian * fit.weights()[:, None]
    normal = np.outer(chain, chain) * (weighted.T @ level.jacobian)
    right = chain * (weighted.T @ fit.residual)
    normal[:6, :6] += information
    right[:6] -= information @ off
    diagonal = np.diag(normal).copy()
    normal[np.diag_indices(8)] += damping * diagonal + 1e-12 * diagonal.max()
    return np.asarray(np.linalg.solve(normal, right))
