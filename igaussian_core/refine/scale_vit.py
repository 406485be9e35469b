"""The paper's learned scale: a small Transformer that tells the pose between image and render.

In the manner of Rockwell, Johnson and Fouhey, "The 8-Point Algorithm as an Inductive Bias for
Relative Pose Prediction by ViTs", 3DV 2022: tokens of both images attend to each other; the
attention multiplies positions of one image with positions of the other, as quadratic forms of
normalised pixel coordinates, which gives the sums that the eight-point algorithm is made of.

Two images alone do not tell how far apart they were taken. Here one is a render, whose depth is
known: the network works in units of the render's median depth and so fits maps of any unit.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import safetensors
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from safetensors.torch import load_file
from torch import Tensor, nn

from igaussian_core.camera import Camera
from igaussian_core.errors import WeightsError

WEIGHTS = Path(__file__).parents[1] / "weights" / "scale_vit.safetensors"
SIDE = 96  # pixels of the network's camera
STRIDE = 8
GRID = SIDE // STRIDE
# 48 degrees: a little more than the narrowest usual view; wider images are cropped
CAMERA = Camera(SIDE, SIDE, 108.0, 108.0, (SIDE - 1) / 2, (SIDE - 1) / 2)

_POSITIONS = 6  # x, y, x^2, xy, y^2, 1
_LEAST_COVERED = 0.02  # share of pixels without which there is no median depth
_LENGTH = 0.05  # typical |t| over median depth: the network's output is relative to it


@dataclass(frozen=True)
class Prediction:
    """Poses of b's camera as seen from a's, x_b = R x_a + t, for a batch.

    Attributes:
        rotation: [B, 3, 3].
        direction: [B, 3], unit vectors along t.
        log_length: [B], natural logarithm of |t| over a's median depth.
        log_attention: [B, heads, N, N], logarithms of a's tokens' attention to b's.
        found: [B, N, 2], where in b a's tokens are, on the plane z = 1.
        log_depth: [B, N], of a's tokens, in units of a's median depth.
    """

    rotation: Tensor
    direction: Tensor
    log_length: Tensor
    log_attention: Tensor
    found: Tensor
    log_depth: Tensor


class ScaleVit(nn.Module):
    """Relative pose of two images of CAMERA; a is the render, b the photo.

    Args:
        width: of a token.
        heads: of the attention between the images.
        layers: self-attention layers before the images meet.
    """

    def __init__(self, width: int = 64, heads: int = 2, layers: int = 1) -> None:
        super().__init__()
        self.heads = heads
        self.stem = _Stem(width)
        self.place = nn.Linear(_POSITIONS, width)
        self.layers = nn.ModuleList(_Layer(width, 4) for _ in range(layers))
        self.norm = nn.LayerNorm(width)
        self.query_key = nn.Linear(width, width)
        self.value = nn.Linear(width, heads * _CONTENT)
        self.sharpness = nn.Parameter(torch.full((heads,), 2.5))
        self.met = nn.Linear(width + heads * (_CONTENT + _POSITIONS) + _POSITIONS, width)
        self.after = _Layer(width, 4)
        # of a token: trust, depth, a shift of where it was found, and which head to believe
        self.told = nn.Linear(width, 4 + heads)
        products = heads * (_CONTENT + _POSITIONS) ** 2
        self.head = nn.Sequential(
            nn.Linear(products + width, 128), nn.GELU(), nn.Linear(128, 64), nn.GELU(),
            nn.Linear(64, 7),
        )  # fmt: skip
        self.register_buffer("positions", positions(), persistent=False)
        self.positions: Tensor

    def forward(self, a: Tensor, b: Tensor) -> Prediction:
        """Images [B, 3, SIDE, SIDE] in 0..1."""
        tokens = self._tokens(torch.cat([a, b]))
        first, second = tokens.chunk(2)
        log_attention = self._logits(first, second).log_softmax(3)
        mine, moved = self._meet(first, second, log_attention.exp())
        seen = moved.transpose(1, 2).flatten(2)
        place = self.positions.expand(len(a), -1, -1)
        x = self.after(self.met(torch.cat([first, seen, place], 2)))
        told = self.told(x)
        trust = told[..., :1].softmax(1)
        log_depth = 2 * torch.tanh(told[..., 1] / 2)
        # positions() doubles x and y, _meet makes their difference eight times as large
        steps = moved[..., _CONTENT : _CONTENT + 2] / 16
        believed = told[..., 4:].softmax(2).transpose(1, 2)[..., None]
        found = self.positions[:, :2] / 2 + (believed * steps).sum(1) + 0.02 * told[..., 2:4]
        rotation, translation = solve_motion(
            self.positions[:, :2] / 2, (-log_depth).exp(), found, trust[..., 0]
        )
        products = torch.einsum("bhni,bhnj,bn->bhij", mine, moved, trust[..., 0])
        out = self.head(torch.cat([products.flatten(1), (trust * x).sum(1)], 1))
        rotation = rotation_matrices(0.05 * out[:, :3]) @ rotation
        translation = translation + _LENGTH * out[:, 3:6]
        length = (translation.square().sum(1) + 1e-8).sqrt()
        return Prediction(
            rotation, translation / length[:, None], length.log() + 0.5 * out[:, 6],
            log_attention, found, log_depth,
        )  # fmt: skip

    def _tokens(self, images: Tensor) -> Tensor:
        mean, std = images.mean((2, 3), keepdim=True), images.std((2, 3), keepdim=True)
        x = self.stem((images - mean) / (std + 0.02)).flatten(2).transpose(1, 2)
        x = x + self.place(self.positions)
        for layer in self.layers:
            x = layer(x)
        return torch.as_tensor(self.norm(x))

    def _logits(self, first: Tensor, second: Tensor) -> Tensor:
        """Similarities [B, heads, N, N] of unit vectors, sharpened."""
        q, k = (
            F.normalize(_split(self.query_key(x), self.heads), dim=3) for x in (first, second)
        )
        return (q * self.sharpness.exp()[:, None, None]) @ k.transpose(2, 3)

    def _meet(self, own: Tensor, other: Tensor, attention: Tensor) -> tuple[Tensor, Tensor]:
        """Content and position of the own tokens, and how those differ that attention finds."""
        place = self.positions.expand(len(own), self.heads, -1, -1)
        mine = torch.cat([_split(self.value(own), self.heads), place], 3)
        theirs = torch.cat([_split(self.value(other), self.heads), place], 3)
        found = attention @ theirs
        # differences are small against positions: products with them are easier to learn from
        return mine, torch.cat([found[..., :_CONTENT], 8 * (found - mine)[..., _CONTENT:]], 3)


_CONTENT = 8  # numbers of content that a token adds to its position, a head


def positions() -> Tensor:
    """Quadratic forms [N, 6] of the tokens' middles: x, y, x^2, xy, y^2, 1 on the plane z = 1."""
    middle = (torch.arange(GRID) * STRIDE + (STRIDE - 1) / 2 - CAMERA.cx) / CAMERA.fx
    y, x = torch.meshgrid(middle, middle, indexing="ij")
    x, y = x.flatten().float(), y.flatten().float()
    # of about the same size each: half a view is 0.44
    return torch.stack([2 * x, 2 * y, 4 * x * x, 4 * x * y, 4 * y * y, torch.ones_like(x)], 1)


def solve_motion(
    places: Tensor, inverse_depth: Tensor, found: Tensor, weights: Tensor, rounds: int = 3
) -> tuple[Tensor, Tensor]:
    """Rotation [B, 3, 3] and translation [B, 3] by weighted least squares (Gauss-Newton).

    Each round solves the motion-field equations (Longuet-Higgins and Prazdny 1980), whose
    coefficients are the quadratic forms of the places; gradients flow through.

    Args:
        places: [N, 2] in a, on the plane z = 1.
        inverse_depth: [B, N] there.
        found: [B, N, 2], where they are in b.
        weights: [B, N], of sum 1.
    """
    rays = torch.cat([places, torch.ones_like(places[:, :1])], 1).expand(len(found), -1, -1)
    rotation = torch.eye(3, device=found.device).expand(len(found), 3, 3)
    translation = torch.zeros(len(found), 3, device=found.device)
    damping = 1e-4 * torch.eye(6, device=found.device)
    for _ in range(rounds):
        turned = rays @ rotation.transpose(1, 2)
        y = turned + inverse_depth[..., None] * translation[:, None]
        z = y[..., 2].clamp(min=0.1)
        u, v = y[..., 0] / z, y[..., 1] / z
        X, Y, Z = turned.unbind(2)
        d, zero = inverse_depth, torch.zeros_like(u)
        # derivatives by the rotation vector, then by the translation
        J = torch.stack([
            torch.stack([-u * Y, Z + u * X, -Y, d, zero, -u * d], 2) / z[..., None],
            torch.stack([-Z - v * Y, v * X, X, zero, d, -v * d], 2) / z[..., None],
        ], 2)  # fmt: skip
        missing = found - torch.stack([u, v], 2)
        weighted = (weights[..., None, None] * J).flatten(1, 2)
        normal = weighted.transpose(1, 2) @ J.flatten(1, 2) + damping
        side = (weighted * missing.flatten(1)[..., None]).sum(1)
        step = torch.linalg.solve(normal, side)
        rotation = rotation_matrices(step[:, :3].clamp(-0.5, 0.5)) @ rotation
        translation = translation + step[:, 3:].clamp(-0.5, 0.5)
    return rotation, translation


def rotation_matrices(rotvec: Tensor) -> Tensor:
    """[B, 3, 3] of rotation vectors [B, 3] in radians (Rodrigues' formula)."""
    angle = (rotvec.square().sum(1) + 1e-12).sqrt()[:, None, None]
    zero = torch.zeros_like(rotvec[:, 0])
    x, y, z = rotvec.unbind(1)
    K = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], 1).view(-1, 3, 3)
    identity = torch.eye(3, device=K.device)
    return identity + angle.sin() / angle * K + (1 - angle.cos()) / angle**2 * K @ K


def _split(x: Tensor, heads: int) -> Tensor:
    """[B, N, heads * D] to [B, heads, N, D]."""
    return x.unflatten(2, (heads, -1)).transpose(1, 2)


class _Stem(nn.Module):
    """Images to features [B, width, GRID, GRID] by strided convolutions."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(3, 16, 5, 2, 2)
        self.second = nn.Conv2d(16, 32, 3, 2, 1)
        self.third = nn.Conv2d(32, width, 3, 2, 1)
        self.fourth = nn.Conv2d(width, width, 3, 1, 1)
        self.fifth = nn.Conv2d(width, width, 3, 1, 1)

    def forward(self, x: Tensor) -> Tensor:
        x = F.relu(self.second(F.relu(self.first(x))))
        x = self.third(x)
        x = x + self.fourth(F.relu(x))
        return torch.as_tensor(x + self.fifth(F.relu(x)))


class _Layer(nn.Module):
    """A Transformer layer, normalised before each part."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm_attention = nn.LayerNorm(width)
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.norm_mlp = nn.LayerNorm(width)
        self.mlp = nn.Sequential(
            nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width)
        )

    def forward(self, x: Tensor) -> Tensor:
        q, k, v = (_split(p, self.heads) for p in self.qkv(self.norm_attention(x)).chunk(3, 2))
        mixed = F.scaled_dot_product_attention(q, k, v).transpose(1, 2).flatten(2)
        x = x + self.out(mixed)
        return torch.as_tensor(x + self.mlp(self.norm_mlp(x)))


# ---------------------------------------------------------------- in use
class LearnedLength:
    """|t| of a render and a photo, by the network; one for a map, for one thread at a time.

    Raises:
        WeightsError: the weights are missing, damaged, or of another network.
    """

    def __init__(self, weights: Path = WEIGHTS) -> None:
        self._net = load_scale_vit(weights)

    def __call__(
        self, camera: Camera, render: NDArray[np.uint8], depth: NDArray[np.float32],
        covered: NDArray[np.bool_], image: NDArray[np.uint8],
    ) -> float:  # fmt: skip
        """Length in the depth's unit; NaN where the map covers next to nothing of the view.

        Args:
            camera: pinhole, of all four.
            render: uint8 RGB [H, W, 3] at the hypothesis, `depth` [H, W] with it.
            covered: [H, W], where the depth counts.
            image: uint8 RGB [H, W, 3], the photo.
        """
        a, b = (_tensor(as_seen_by_network(camera, view)) for view in (render, image))
        seen = _depths_seen(camera, depth, covered)
        if len(seen) < _LEAST_COVERED * SIDE * SIDE:
            return float("nan")
        with torch.inference_mode():
            length = float(self._net(a, b).log_length.exp())
        return length * float(np.median(seen))


def load_scale_vit(path: Path) -> ScaleVit:
    """The network with the weights of a file, ready for use.

    Raises:
        WeightsError: no such file, no safetensors, a layer missing, one too many, another shape,
            or a value that is not finite.
    """
    try:
        state = load_file(path)
    except (OSError, safetensors.SafetensorError) as error:
        raise WeightsError(f"{path}: no weights of the scale ViT: {error}") from error
    net = ScaleVit()
    wanted = net.state_dict()
    for cause, names in (
        ("missing", wanted.keys() - state.keys()),
        ("unknown", state.keys() - wanted.keys()),
        ("of another shape", {n for n in wanted.keys() & state.keys()
                              if wanted[n].shape != state[n].shape}),
        ("not finite", {n for n, value in state.items() if not bool(value.isfinite().all())}),
    ):  # fmt: skip
        if names:
            listed = ", ".join(sorted(names)[:4])
            raise WeightsError(f"{path}: of another network: {len(names)} {cause}: {listed}")
    net.load_state_dict({name: value.float() for name, value in state.items()})
    return net.eval()


def as_seen_by_network(camera: Camera, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The image [SIDE, SIDE, 3] that CAMERA would have taken; black beyond the view."""
    factor = CAMERA.fx / camera.fx, CAMERA.fy / camera.fy
    if min(factor) < 0.7:  # first by averaging, as pixels of the network's camera would
        size = tuple(max(1, round(n * min(f, 1))) for n, f in
                     zip((camera.width, camera.height), factor, strict=True))  # fmt: skip
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        camera = camera.resized(*size)
    return np.asarray(
        cv2.warpAffine(image, _onto(camera), (SIDE, SIDE), flags=_BACKWARDS | cv2.INTER_LINEAR),
        np.uint8,
    )


def _depths_seen(
    camera: Camera, depth: NDArray[np.float32], covered: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Covered depths [M] in the network's view."""
    flags = _BACKWARDS | cv2.INTER_NEAREST
    kept = np.where(covered, depth, 0).astype(np.float32)
    seen = np.asarray(cv2.warpAffine(kept, _onto(camera), (SIDE, SIDE), flags=flags), np.float32)
    return seen[seen > 0]


_BACKWARDS = cv2.WARP_INVERSE_MAP


def _onto(camera: Camera) -> NDArray[np.float64]:
    """[2, 3], from pixels of the network's camera to those of a pinhole camera."""
    sx, sy = camera.fx / CAMERA.fx, camera.fy / CAMERA.fy
    return np.array([[sx, 0, camera.cx - sx * CAMERA.cx], [0, sy, camera.cy - sy * CAMERA.cy]])


def _tensor(image: NDArray[np.uint8]) -> Tensor:
    return torch.from_numpy(image).permute(2, 0, 1)[None] / 255.0
