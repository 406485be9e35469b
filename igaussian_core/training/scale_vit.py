"""Training of the scale ViT: pairs rendered from procedural maps, with known poses.

A run keeps its pairs and its state in the folder and goes on where it was stopped. Supervised are
the relative pose in units of the render's median depth, and the attention between the images,
by the rendered depth: without it the network takes far longer to find out what attention is for.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import repeat
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from matplotlib.figure import Figure
from numpy.typing import NDArray
from safetensors.torch import save_file
from torch import Tensor

from igaussian_core.errors import WeightsError
from igaussian_core.gaussian_map import GaussianMap
from igaussian_core.geometry import compose, inverse, rotation_from_vector
from igaussian_core.procedural import ProceduralMap, make_object, make_room
from igaussian_core.refine.scale_vit import CAMERA, GRID, SIDE, STRIDE, Prediction, ScaleVit
from igaussian_core.views import look_at

Array = NDArray[np.float64]

VIEWS = 4  # of one place: every ordered pair of them is an example
_MIN_COVERED = 0.15
_MAX_TURN_DEG = 10.0
_MAX_MOVE = 0.15  # of the median depth
_OBJECT_SHARE = 0.4
_TRIES = 8
_HELD_OUT = 1_000_000  # seeds of maps from here on are never trained on


@dataclass(frozen=True)
class ScaleTraining:
    """How to train.

    Attributes:
        maps, places: procedural maps, and places in each from which VIEWS views are rendered.
        held_out_maps, held_out_places: likewise, of maps that are never trained on.
        steps, batch: of the optimiser.
        rate: highest learning rate; it rises over the first steps and falls as a cosine.
        every: steps between validations, each of which also saves.
    """

    maps: int = 120
    places: int = 60
    held_out_maps: int = 12
    held_out_places: int = 20
    steps: int = 6000
    batch: int = 24
    rate: float = 3e-3
    every: int = 250
    seed: int = 0


@dataclass(frozen=True)
class Views:
    """Rendered views; those of one place follow each other, VIEWS of them.

    Attributes:
        images: [V, SIDE, SIDE, 3] uint8.
        depths: [V, GRID, GRID] float32 at the tokens' middles, 0 where nothing opaque is.
        T_scene_cam: [V, 4, 4].
        medians: [V] median depth of what is opaque.
    """

    images: NDArray[np.uint8]
    depths: NDArray[np.float32]
    T_scene_cam: Array
    medians: Array

    def __len__(self) -> int:
        return len(self.images)


# ---------------------------------------------------------------- pairs
# image, depths at tokens, pose, median depth
_Shot = tuple[NDArray[np.uint8], NDArray[np.float32], Array, float]


def render_views(
    seeds: Sequence[int], places: int, threads: int = 1,
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> Views:  # fmt: skip
    """Views of the procedural maps with these seeds, made by so many processes."""
    parts = []
    with ProcessPoolExecutor(threads, get_context("spawn")) as workers:
        for part in workers.map(_views_of_seed, seeds, repeat(places)):
            parts.append(part)
            progress(len(parts), len(seeds))
    return join(parts)


def _views_of_seed(seed: int, places: int) -> Views:
    rng = np.random.default_rng([seed, 3])
    make = make_object if rng.random() < _OBJECT_SHARE else make_room
    return views_of(make(seed), places, rng)


def join(parts: list[Views]) -> Views:
    return Views(
        np.concatenate([p.images for p in parts]), np.concatenate([p.depths for p in parts]),
        np.concatenate([p.T_scene_cam for p in parts]), np.concatenate([p.medians for p in parts]),
    )  # fmt: skip


def views_of(made: ProceduralMap, places: int, rng: np.random.Generator) -> Views:
    """VIEWS views near each of `places` places of a map."""
    draw: Callable[[], Array] = lambda: _pose(made, rng)  # noqa: E731
    return views_about(made.gmap, draw, places, rng)


def views_about(
    gmap: GaussianMap, draw: Callable[[], Array], places: int, rng: np.random.Generator
) -> Views:
    """VIEWS views near each of `places` poses T_scene_cam that `draw` gives."""
    shots: list[_Shot] = []
    while len(shots) < places * VIEWS:
        background = tuple(rng.choice([np.zeros(3), np.ones(3), rng.random(3)]))
        for _ in range(_TRIES):
            first = _shoot(gmap, draw(), background)
            if first is not None:
                break
        else:
            continue
        cluster = [first]
        for _ in range(_TRIES * VIEWS):
            near = _shoot(gmap, _moved(first[2], first[3], rng), background)
            if near is not None:
                cluster.append(near)
            if len(cluster) == VIEWS:
                shots += cluster
                break
    images, depths, poses, medians = zip(*shots, strict=True)
    return Views(np.array(images), np.array(depths), np.array(poses), np.array(medians))


def _pose(made: ProceduralMap, rng: np.random.Generator) -> Array:
    """A random T_scene_cam: anywhere in a room, about an object."""
    if made.free is None:
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        position = made.centre + made.radius * rng.uniform(0.6, 1.1) * direction
        target = made.centre + rng.normal(0, 0.2, 3)
    else:
        position = made.free_positions(rng, 1)[0]
        azimuth, pitch = rng.uniform(0, 2 * np.pi), rng.normal(0, 0.3)
        target = position + [np.cos(azimuth), np.sin(azimuth), pitch]
    roll = compose(rotation_from_vector([0, 0, rng.normal(0, 0.06)]), np.zeros(3))
    return look_at(position, target) @ roll


def _moved(T_scene_cam: Array, depth: float, rng: np.random.Generator) -> Array:
    """As far off as stage one errs: small errors are more frequent."""
    axis, direction = rng.normal(size=(2, 3))
    turn = np.radians(_MAX_TURN_DEG) * rng.random() * axis / np.linalg.norm(axis)
    length = _MAX_MOVE * depth * rng.random() ** 1.3
    move = compose(rotation_from_vector(turn), length * direction / np.linalg.norm(direction))
    return np.asarray(T_scene_cam @ move)


def _shoot(
    gmap: GaussianMap, T_scene_cam: Array, background: tuple[float, ...]
) -> _Shot | None:
    """Image, depths at tokens, pose, median depth; None where too little is to be seen."""
    rgb, depth, alpha = gmap.render(CAMERA, inverse(T_scene_cam), background, threads=1)  # type: ignore[arg-type]
    opaque = alpha > 0.8
    if opaque.mean() < _MIN_COVERED:
        return None
    half = STRIDE // 2
    at_tokens = np.where(opaque, depth, 0)[half::STRIDE, half::STRIDE]
    image = np.clip(rgb * 255 + 0.5, 0, 255).astype(np.uint8)
    if cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).std() < 6:
        return None
    return image, at_tokens.astype(np.float32), T_scene_cam, float(np.median(depth[opaque]))


# ---------------------------------------------------------------- examples
@dataclass(frozen=True)
class Batch:
    """Ordered pairs: images [B, 3, SIDE, SIDE] in 0..1, and x_b = rotation @ x_a + translation in
    units of a's median depth.

    Attributes:
        targets, weights: [B, N, 4], the four tokens of b around a token of a, and their shares,
            all 0 where the place is not to be seen in b.
        places: [B, N, 2], where in b a's tokens are, on the plane z = 1.
        depths: [B, N], of a's tokens in units of a's median; 0 where there is none.
    """

    a: Tensor
    b: Tensor
    rotation: Tensor
    translation: Tensor
    targets: Tensor
    weights: Tensor
    places: Tensor
    depths: Tensor

    def to(self, device: str) -> Batch:
        """All on a device."""
        return Batch(*(part.to(device) for part in vars(self).values()))


def batches(
    views: Views, batch: int, steps: range, seed: int, device: str = "cpu"
) -> Iterator[Batch]:
    """One batch a step; the same for the same step, so that a stopped run can go on."""
    for step in steps:
        rng = np.random.default_rng([seed, step])
        place = rng.integers(len(views) // VIEWS, size=batch)
        order = np.argsort(rng.random((batch, VIEWS)), axis=1)[:, :2]
        drawn = pairs(views, place * VIEWS + order[:, 0], place * VIEWS + order[:, 1], device)
        yield changed(drawn, rng)


def all_pairs(views: Views, seed: int) -> Batch:
    """Two pairs of each place: the first view with the second, the third with the fourth."""
    index = np.arange(0, len(views), 2)
    return changed(pairs(views, index, index + 1), np.random.default_rng(seed), masks=False)


def pairs(
    views: Views, a: NDArray[np.int64], b: NDArray[np.int64], device: str = "cpu"
) -> Batch:
    """The views a as renders and b as photos, index by index."""
    T = inverse(views.T_scene_cam[b]) @ views.T_scene_cam[a]
    R, t = T[:, :3, :3], T[:, :3, 3]
    targets, weights, places = _correspondences(views.depths[a], views.depths[b], R, t)
    images = [
        torch.from_numpy(views.images[i]).to(device).permute(0, 3, 1, 2) / 255.0 for i in (a, b)
    ]
    return Batch(
        images[0], images[1], torch.from_numpy(R).float(),
        torch.from_numpy(t / views.medians[a][:, None]).float(),
        torch.from_numpy(targets), torch.from_numpy(weights).float(),
        torch.from_numpy(places).float(),
        torch.from_numpy(views.depths[a] / views.medians[a][:, None, None]).float().flatten(1),
    ).to(device)  # fmt: skip


def _correspondences(
    depth_a: NDArray[np.float32], depth_b: NDArray[np.float32], R: Array, t: Array
) -> tuple[NDArray[np.int64], Array, Array]:
    """Where a's tokens are in b: four tokens around the place, bilinear shares, the place."""
    middle = (np.arange(GRID) * STRIDE + STRIDE // 2 - CAMERA.cx) / CAMERA.fx
    y, x = np.meshgrid(middle, middle, indexing="ij")
    rays = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    z = depth_a.reshape(len(R), -1, 1)
    points = (rays * z) @ R.swapaxes(1, 2) + t[:, None]
    ahead = points[..., 2:] > 1e-6
    uv = points[..., :2] / np.where(ahead, points[..., 2:], 1)
    cell = (uv * CAMERA.fx + CAMERA.cx - STRIDE // 2) / STRIDE
    inside = np.all((cell > -0.5) & (cell < GRID - 0.5), axis=2) & ahead[..., 0] & (z[..., 0] > 0)
    cell = np.clip(np.where(inside[..., None], cell, 0), 0, GRID - 1 - 1e-6)
    low, share = np.floor(cell).astype(int), cell % 1
    near = np.rint(cell).astype(int)
    there = depth_b[np.arange(len(R))[:, None], near[..., 1], near[..., 0]]
    inside &= np.abs(there - points[..., 2]) < 0.15 * points[..., 2]  # else something is before it
    corners = [(dx, dy) for dy in (0, 1) for dx in (0, 1)]
    index = np.stack([
        np.minimum(low[..., 1] + dy, GRID - 1) * GRID + np.minimum(low[..., 0] + dx, GRID - 1)
        for dx, dy in corners
    ], -1)  # fmt: skip
    weight = np.stack([
        (share[..., 0] if dx else 1 - share[..., 0]) * (share[..., 1] if dy else 1 - share[..., 1])
        for dx, dy in corners
    ], -1)  # fmt: skip
    return index, weight * inside[..., None], np.where(inside[..., None], uv, 0)


def changed(batch: Batch, rng: np.random.Generator, masks: bool = True) -> Batch:
    """The photo as a camera would have taken it: exposure, white balance, gamma, blur, noise;
    and sometimes a border about both images, as a narrower camera leaves."""
    n, device = len(batch.a), batch.a.device

    def draw(low: float, high: float, channels: int = 1) -> Tensor:
        values = rng.uniform(low, high, (n, channels, 1, 1))
        return torch.from_numpy(values).float().to(device)

    b = batch.b.clamp(1e-4) ** draw(0.75, 1.33)
    b = b * draw(0.6, 1.5) * draw(0.9, 1.1, 3)
    soft = F.avg_pool2d(F.pad(b, (1, 1, 1, 1), mode="replicate"), 3, 1)
    b = torch.lerp(b, soft, draw(0, 1))
    random = torch.Generator(device).manual_seed(int(rng.integers(1 << 62)))
    noise = torch.randn(b.shape, generator=random, device=device)
    b = (b + noise * draw(0, 0.04)).clamp(0, 1)
    a = batch.a
    if masks:
        half = torch.where(draw(0, 1) < 0.35, draw(0.6, 1.0), torch.ones_like(b[:, :1, :1, :1]))
        axis = torch.linspace(-1, 1, SIDE, device=device).abs()
        seen = (torch.maximum(axis[:, None], axis[None]) <= half).float()
        a, b = a * seen, b * seen
    return replace(batch, a=a, b=b)


# ---------------------------------------------------------------- loss
def loss_of(predicted: Prediction, batch: Batch) -> dict[str, Tensor]:
    """The parts of the loss by name, weighted; their sum is minimised."""
    length = batch.translation.norm(dim=1)
    sure = length / (length + 0.02)  # a short way has hardly a direction
    direction = batch.translation / length.clamp(min=1e-6)[:, None]
    wanted = length.clamp(min=0.005).log()
    moved = predicted.log_length.exp()[:, None] * predicted.direction - batch.translation
    chosen = predicted.log_attention.gather(
        3, batch.targets[:, None].expand(-1, predicted.log_attention.shape[1], -1, -1)
    )
    attention = -(batch.weights[:, None] * chosen).sum()
    seen = batch.weights.sum(2)
    count = seen.sum().clamp(min=1) * predicted.log_attention.shape[1]
    missed = (predicted.found - batch.places).norm(dim=2)
    deep = batch.depths > 0
    depth = (predicted.log_depth - batch.depths.clamp(min=1e-3).log()).abs()
    turned = rotation_error(predicted.rotation, batch.rotation)
    return {
        "rotation": 15 * turned.mean(),
        "direction": (sure * (1 - (predicted.direction * direction).sum(1))).mean(),
        "length": 2 * (sure * (predicted.log_length - wanted).abs()).mean(),
        "translation": 10 * moved.norm(dim=1).mean(),
        "attention": attention / count,
        "place": 10 * (missed * seen).sum() / seen.sum().clamp(min=1),
        "depth": (depth * deep).sum() / deep.sum().clamp(min=1),
    }


def rotation_error(first: Tensor, second: Tensor) -> Tensor:
    """Angles [B] in radians between rotations [B, 3, 3]; the gradient is finite at 0 too."""
    chord = (first - second).square().sum((1, 2))
    return 2 * torch.asin((chord / 8 + 1e-10).sqrt().clamp(max=1 - 1e-4))


@torch.inference_mode()
def validate(net: ScaleVit, batch: Batch) -> dict[str, float]:
    """Median errors over pairs that moved at least 1 % of the depth.

    `scale` is |t| against the true one, as a share of it; `constant` is the same for the best
    constant answer.
    """
    net.eval()
    parts = [
        net(a, b) for a, b in zip(batch.a.split(64), batch.b.split(64), strict=True)
    ]
    log_length = torch.cat([p.log_length for p in parts])
    direction = torch.cat([p.direction for p in parts])
    rotation = torch.cat([p.rotation for p in parts])
    net.train()
    length = batch.translation.norm(dim=1)
    far = length > 0.01
    cosine = (direction * batch.translation).sum(1) / length.clamp(min=1e-9)
    turned = rotation_error(rotation, batch.rotation)
    ratio = (log_length - length.log()).exp()
    constant = length[far].log().median().exp() / length
    return {
        "scale": float((ratio - 1).abs()[far].median()),
        "constant": float((constant - 1).abs()[far].median()),
        "rotation_deg": float(torch.rad2deg(turned.median())),
        "direction_deg": float(torch.rad2deg(cosine[far].clamp(-1, 1).acos().median())),
    }


# ---------------------------------------------------------------- the run
def train_scale_vit(
    folder: Path,
    options: ScaleTraining = ScaleTraining(),
    minutes: float | None = None,
    progress: Callable[[str, int, int], None] = lambda stage, done, of: None,
    threads: int = 2,
    device: str = "cpu",
) -> dict[str, float]:
    """Train, or go on training, in a folder; writes scale_vit.safetensors, curves.json and .png.

    Args:
        minutes: stop after so many; the next call goes on.
        progress: told the stage, how much of it is done, and of how much.
        threads: that render views.
        device: of the network: cpu or cuda.

    Returns:
        The errors of `validate` on held-out procedural maps when last looked at.

    Raises:
        WeightsError: the folder's state is of another training.
    """
    folder.mkdir(parents=True, exist_ok=True)
    train, held_out = _views(folder, options, threads, progress)
    run = _Run(folder, options, all_pairs(held_out, options.seed).to(device), device)
    run.resume()
    stop = None if minutes is None else time.monotonic() + 60 * minutes
    steps = range(run.step, options.steps)
    for batch in batches(train, options.batch, steps, options.seed, device):
        run.advance(batch)
        progress("training", run.step, options.steps)
        if stop is not None and time.monotonic() > stop:
            break
    run.save()
    return run.errors


def _views(
    folder: Path, options: ScaleTraining, threads: int,
    progress: Callable[[str, int, int], None],
) -> tuple[Views, Views]:
    """Views for training and of held-out maps; kept in the folder, since they take minutes."""
    result = []
    for name, first, count, places in (
        ("train", options.seed * 10_000, options.maps, options.places),
        ("held_out", _HELD_OUT, options.held_out_maps, options.held_out_places),
    ):
        file = folder / f"views_{name}_{first}_{count}_{places}.npz"
        if not file.exists():
            tell = partial(progress, f"rendering maps ({name})")
            views = render_views(range(first, first + count), places, threads, tell)
            np.savez(file, **vars(views))
        with np.load(file) as data:
            result.append(Views(**{key: data[key] for key in data.files}))
    return result[0], result[1]


class _Run:
    """Network, optimiser and curves of a training, and where they are kept."""

    def __init__(
        self, folder: Path, options: ScaleTraining, held_out: Batch, device: str
    ) -> None:
        torch.manual_seed(options.seed)
        self.folder, self.options, self.held_out = folder, options, held_out
        self.net = ScaleVit().to(device)
        # of the weights over the last steps, which is what is kept
        self.mean = ScaleVit().to(device)
        self.mean.load_state_dict(self.net.state_dict())
        self.optimiser = torch.optim.AdamW(self.net.parameters(), options.rate, weight_decay=0.02)
        self.step = 0
        self.curves: list[dict[str, float]] = []
        self.running: dict[str, float] = {}
        self.errors: dict[str, float] = {}

    def advance(self, batch: Batch) -> None:
        """One step; now and then a validation."""
        for group in self.optimiser.param_groups:
            group["lr"] = self.options.rate * self._schedule()
        parts = loss_of(self.net(batch.a, batch.b), batch)
        self.optimiser.zero_grad(set_to_none=True)
        torch.stack(list(parts.values())).sum().backward()
        torch.nn.utils.clip_grad_norm_(self.net.parameters(), 1.0)
        self.optimiser.step()
        self.step += 1
        keep = min(0.998, 1 - 1 / self.step)
        with torch.no_grad():
            for slow, fast in zip(self.mean.parameters(), self.net.parameters(), strict=True):
                slow.lerp_(fast, 1 - keep)
        for name, value in parts.items():
            now = float(value.detach())
            self.running[name] = 0.98 * self.running.get(name, now) + 0.02 * now
        if self.step % self.options.every == 0 or self.step == self.options.steps:
            self.check()

    def _schedule(self) -> float:
        """Share of the highest rate: up over the first 5 %, then down as a cosine."""
        done = self.step / self.options.steps
        return min(1.0, done / 0.05 + 0.02) * (0.02 + 0.49 * (1 + float(np.cos(np.pi * done))))

    def check(self) -> None:
        """Errors on held-out maps, and the weights as they are: choosing the best of several by
        these errors would make them look better than they are."""
        self.errors = validate(self.mean, self.held_out)
        self.curves.append({"step": self.step, **self.running, **self.errors})
        file = self.folder / "scale_vit.safetensors"
        save_weights(self.mean, file, self.errors, {**asdict(self.options), "done": self.step})
        self.save()

    def save(self) -> None:
        """All that going on needs, and the curves."""
        state = {
            "net": self.net.state_dict(), "mean": self.mean.state_dict(), "step": self.step,
            "optimiser": self.optimiser.state_dict(), "curves": self.curves, "errors": self.errors,
            "running": self.running, "options": asdict(self.options),
        }  # fmt: skip
        temporary = self.folder / "state.tmp"
        torch.save(state, temporary)
        temporary.replace(self.folder / "state.pt")
        (self.folder / "curves.json").write_text(json.dumps(self.curves, indent=1))
        if self.curves:
            plot(self.curves, self.folder / "curves.png")

    def resume(self) -> None:
        """The state that the folder holds, if any; only the number of steps may have changed.

        Raises:
            WeightsError: it was made with other options.
        """
        file = self.folder / "state.pt"
        if not file.exists():
            return
        state = torch.load(file, weights_only=True)
        if {**state["options"], "steps": self.options.steps} != asdict(self.options):
            raise WeightsError(
                f"{file}: made with {state['options']}, not with {asdict(self.options)}: "
                "take another folder, or the same options (but for steps)"
            )
        self.net.load_state_dict(state["net"])
        self.mean.load_state_dict(state["mean"])
        self.optimiser.load_state_dict(state["optimiser"])
        self.step, self.curves, self.errors = state["step"], state["curves"], state["errors"]
        self.running = state["running"]


def save_weights(
    net: ScaleVit, file: Path, errors: dict[str, float], training: dict[str, float]
) -> None:
    """fp16 tensors, with what they reached and how they were trained in the file's metadata."""
    tensors = {name: value.half().cpu().contiguous() for name, value in net.state_dict().items()}
    about = {"errors": json.dumps(errors), "training": json.dumps(training)}
    save_file(tensors, file, metadata=about)


def plot(curves: list[dict[str, float]], file: Path) -> None:
    """Loss and held-out errors over the steps, as a picture."""
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    steps = [point["step"] for point in curves]
    for name in ("rotation", "direction", "length", "translation", "attention", "place", "depth"):
        left.plot(steps, [point[name] for point in curves], label=name)
    left.set(xlabel="step", title="training loss by part")
    left.legend(fontsize=7)
    for name in ("scale", "constant"):
        right.plot(steps, [100 * point[name] for point in curves], label=f"{name}, %")
    right.plot(steps, [point["direction_deg"] for point in curves], label="direction, deg")
    right.plot(steps, [10 * point["rotation_deg"] for point in curves], label="rotation, 0.1 deg")
    right.set(xlabel="step", title="median errors, held-out maps", ylim=(0, 100))
    right.legend(fontsize=7)
    figure.savefig(file, dpi=110)
