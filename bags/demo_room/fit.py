"""Fits the laid Gaussians to noise-free pictures of the room, as a 3DGS map is trained.

Of overlapping opaque Gaussians in one plane the nearer hides the farther, so that a laid texture
appears shifted away from the viewer by a fifth of a cell. Fitting to views from all sides takes
most of that away: Adam through the differentiable renderer changes colours, opacities, and places
and sizes within each surface; number, thickness and rotations stay. The views are those of the
mapping run and more of their kind, none of the drive's: those added keep clear of its track.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from igaussian_core import Camera
from igaussian_core.render.torch_op import render
from igaussian_core.torch_cpu import one_torch_thread

from . import sensor
from .drive import Drive, image_times, mapping_poses, optical
from .gaussians import SH_C0, Gaussians
from .raycast import Array32, RayCaster, Rays
from .surfaces import Array, Image, Room

STEPS = 800
EXTRA_VIEWS = 60
CLEAR_OF_DRIVE, CLEAR_OF_WALLS = 0.2, 0.3  # metres
PLACES = np.array([[0.25, -0.25], [-0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]])  # rays of a pixel
# per step at the start: colour (0..1), logit opacity, place (in laid sigmas), log size
RATES = {"colour": 0.01, "opacity": 0.05, "place": 0.02, "size": 0.015}
LAST_RATE = 0.05  # of the first
LARGEST_MOVE = 1.0  # in laid sigmas
SIZES = (0.4, 1.6)  # of the laid sigmas
OPACITIES = (0.02, 0.995)
CONTRAST_SIGMA, CONTRAST_FLOOR = 6.0, 0.012  # pixels; of the range 0..1
DEPTH_WEIGHT, ALPHA_WEIGHT, EDGE_WEIGHT = 0.1, 0.1, 1.0
LARGEST_DEPTH_ERROR = 0.05  # relative; beyond, a silhouette is off by a pixel


@dataclass(frozen=True)
class View:
    """What a mapping camera sees: colour uint8 [H, W, 3], depth float32 [H, W] metres."""

    camera: Camera
    T_cam_map: Array
    colour: Image
    depth: Array32


def mapping_camera() -> Camera:
    """The mapping run's pinhole camera."""
    return Camera(sensor.WIDTH, sensor.HEIGHT, sensor.FX, sensor.FY, sensor.CX, sensor.CY)


def fitting_poses(room: Room, extra: int = EXTRA_VIEWS) -> list[Array]:
    """T_map_cam [4, 4] of the mapping run, and of `extra` places anywhere in the free room."""
    drive = Drive()
    driven = np.array([drive.T_map_cam(float(t))[:3, 3] for t in image_times()])
    rng = np.random.default_rng(77)
    poses = mapping_poses()
    wanted = len(poses) + extra
    low = np.array([CLEAR_OF_WALLS, CLEAR_OF_WALLS, 0.45])
    high = np.array([room.width - CLEAR_OF_WALLS, room.depth - CLEAR_OF_WALLS, 1.1])
    while len(poses) < wanted:
        T = np.eye(4)
        T[:3, 3] = np.round(rng.uniform(low, high), 4)
        yaw, pitch = np.round(rng.uniform((0.0, -8.0), (360.0, 14.0)), 2)
        T[:3, :3] = optical(float(np.radians(yaw)), float(np.radians(pitch)))
        blocked = any(solid.contains(T[:3, 3], CLEAR_OF_WALLS) for solid in room.solids)
        if not blocked and np.linalg.norm(driven - T[:3, 3], axis=1).min() > CLEAR_OF_DRIVE:
            poses.append(T)
    return poses


def pinhole_rays(camera: Camera, dx: float = 0.0, dy: float = 0.0) -> Rays:
    """Rays of a pinhole camera's pixels, shifted by (dx, dy) pixels."""
    cols, rows = np.meshgrid(np.arange(camera.width) + dx, np.arange(camera.height) + dy)
    x = ((cols - camera.cx) / camera.fx).astype(np.float32)
    return Rays(x, ((rows - camera.cy) / camera.fy).astype(np.float32))


def take_view(caster: RayCaster, camera: Camera, T_map_cam: Array) -> View:
    """A noise-free picture, four rays a pixel."""
    casts = [caster.cast(pinhole_rays(camera, *place), T_map_cam) for place in PLACES]
    total = np.sum([colour for colour, _ in casts], 0, dtype=np.uint16)
    colour = ((total + len(PLACES) // 2) // len(PLACES)).astype(np.uint8)
    depth = np.asarray(np.mean([depth for _, depth in casts], 0), np.float32)
    return View(camera, np.asarray(np.linalg.inv(T_map_cam)), colour, depth)


class FreeMap:
    """The laid map and the changes that are searched for."""

    def __init__(self, laid: Gaussians) -> None:
        self.laid = laid
        axes = tangents(laid.quats_wxyz) * laid.scales[:, :2, None]
        self.means, self.axes = _tensor(laid.means), _tensor(axes)
        self.scales, self.quats = _tensor(laid.scales), _tensor(laid.quats_wxyz)
        self.free = {
            "colour": _tensor(laid.colours),
            "opacity": _tensor(_logit(laid.opacities)),
            "place": torch.zeros(len(laid), 2),
            "size": torch.zeros(len(laid), 2),
        }
        for value in self.free.values():
            value.requires_grad_()

    def parts(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """means, quats_wxyz, scales, opacities, sh as the renderer takes them."""
        free = self.free
        means = self.means + (free["place"][..., None] * self.axes).sum(1)
        scales = torch.cat([self.scales[:, :2] * free["size"].exp(), self.scales[:, 2:]], 1)
        sh = ((free["colour"] - 0.5) / SH_C0)[:, None]
        return means, self.quats, scales, free["opacity"].sigmoid(), sh

    @torch.no_grad()
    def restrain(self) -> None:
        """Keep each Gaussian near its cell."""
        self.free["colour"].clamp_(0, 1)
        self.free["opacity"].clamp_(*_logit(np.array(OPACITIES)))
        self.free["place"].clamp_(-LARGEST_MOVE, LARGEST_MOVE)
        self.free["size"].clamp_(*np.log(SIZES))

    def fitted(self, room: Room) -> Gaussians:
        """The changed map."""
        free = {name: value.detach().double().numpy() for name, value in self.free.items()}
        scales = self.laid.scales.copy()
        axes = tangents(self.laid.quats_wxyz) * scales[:, :2, None]
        moves = (free["place"][..., None] * axes).sum(1)
        means = self.laid.means + moves * _share_inside(room, self.laid.means, moves)[:, None]
        scales[:, :2] *= np.exp(free["size"])
        opacities = 1 / (1 + np.exp(-free["opacity"]))
        return Gaussians(means, self.laid.quats_wxyz, scales, free["colour"], opacities)


def _share_inside(room: Room, places: Array, moves: Array) -> Array:
    """How much [N], 0..1, of each move stays in the room."""
    size = np.array([room.width, room.depth, room.height])
    left = np.where(moves > 0, size - places, places)
    far = np.abs(moves) > 1e-6  # metres; less is the rounding of a move within a wall
    share = np.where(far, left / np.where(far, np.abs(moves), 1), 1.0)
    return np.asarray(np.clip(share.min(1), 0, 1))


def fit(
    laid: Gaussians,
    room: Room,
    views: list[View],
    steps: int = STEPS,
    report: Callable[[str], None] = lambda line: None,
) -> Gaussians:
    """The laid map after Adam steps on one view each, in a fixed random order.

    The same bytes each time with one instruction set; others round differently, see compare.py.
    """
    free = FreeMap(laid)
    groups = [{"params": [free.free[name]], "lr": rate} for name, rate in RATES.items()]
    adam = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-12)
    decay = torch.optim.lr_scheduler.ExponentialLR(adam, LAST_RATE ** (1 / steps))
    rng, rounds = np.random.default_rng(78), -(-steps // len(views))
    order = np.concatenate([rng.permutation(len(views)) for _ in range(rounds)])
    with one_torch_thread():
        for step in range(steps):
            loss = _loss(views[order[step]], free)
            adam.zero_grad()
            loss.backward()
            adam.step()
            decay.step()
            free.restrain()
            if step % 50 == 0 or step == steps - 1:
                report(f"step {step + 1} of {steps}: loss {loss.item():.4f}")
    return free.fitted(room)


def _loss(view: View, free: FreeMap) -> Tensor:
    """Absolute errors of colour and its edges in units of local contrast; of depth and alpha."""
    rgb, depth, alpha = render(*free.parts(), view.camera, torch.from_numpy(view.T_cam_map))
    weight = torch.from_numpy(_contrast_weight(view.colour))[..., None]
    error = rgb - torch.from_numpy(view.colour.astype(np.float32) / 255)
    across = (error[:, 1:] - error[:, :-1]).abs() * weight[:, 1:]
    down = (error[1:] - error[:-1]).abs() * weight[1:]
    relative = (depth / torch.from_numpy(view.depth) - 1).abs().clamp(max=LARGEST_DEPTH_ERROR)
    return (
        (error.abs() * weight).mean()
        + EDGE_WEIGHT * (across.mean() + down.mean())
        + DEPTH_WEIGHT * relative.mean() / LARGEST_DEPTH_ERROR
        + ALPHA_WEIGHT * (1 - alpha).mean()
    )


def _contrast_weight(colour: Image) -> Array32:
    """One over the local standard deviation of brightness [H, W]: faint texture counts too."""
    grey = colour.astype(np.float32).mean(2) / 255
    mean = cv2.GaussianBlur(grey, (0, 0), CONTRAST_SIGMA)
    square = cv2.GaussianBlur(grey * grey, (0, 0), CONTRAST_SIGMA)
    spread = np.sqrt(np.maximum(square - mean * mean, 0))
    return np.asarray(0.1 / (spread + CONTRAST_FLOOR), np.float32)


def tangents(quats_wxyz: Array) -> Array:
    """First two axes [N, 2, 3] of unit quaternions [N, 4]."""
    w, x, y, z = quats_wxyz.T
    first = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], 1)
    second = np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], 1)
    return np.stack([first, second], 1)


def _tensor(values: Array) -> Tensor:
    return torch.from_numpy(np.asarray(values, np.float32))


def _logit(probabilities: Array) -> Array:
    return np.asarray(np.log(probabilities / (1 - probabilities)))
