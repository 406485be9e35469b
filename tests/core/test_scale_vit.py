"""The learned scale: strict weights, its geometry, its units, and its place in the refiner."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import room as rooms
import torch
from safetensors.torch import load_file, save_file

from igaussian_core.camera import Camera
from igaussian_core.config import Config, RefineConfig
from igaussian_core.errors import ConfigError, WeightsError
from igaussian_core.geometry import (
    compose,
    inverse,
    pose_error,
    rotation_from_vector,
    transform_points,
)
from igaussian_core.localizer import Localizer
from igaussian_core.procedural import make_object, make_room
from igaussian_core.refine import scales
from igaussian_core.refine.relative import bearings, solve_relative
from igaussian_core.refine.scale_vit import (
    CAMERA,
    GRID,
    SIDE,
    STRIDE,
    WEIGHTS,
    LearnedLength,
    ScaleVit,
    as_seen_by_network,
    load_scale_vit,
    positions,
    rotation_matrices,
    solve_motion,
)
from igaussian_core.training.scale_vit import (
    VIEWS,
    ScaleTraining,
    Views,
    all_pairs,
    batches,
    join,
    loss_of,
    pairs,
    train_scale_vit,
    validate,
    views_of,
)
from igaussian_core.views import look_at

PHOTO = Camera(320, 240, 260.0, 255.0, 161.0, 118.0)


@pytest.fixture(scope="module")
def views() -> Views:
    """Views of a procedural room, a few places."""
    return views_of(make_room(5), 6, np.random.default_rng(0))


@pytest.fixture(scope="module")
def length() -> LearnedLength:
    return LearnedLength()


def random_pair(seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Render, its depth, what is covered, and photo, of PHOTO's size."""
    rng = np.random.default_rng(seed)
    image = rng.integers(0, 255, (2, 30, 40, 3), np.uint8).repeat(8, 1).repeat(8, 2)
    depth = rng.uniform(1, 3, (240, 320)).astype(np.float32)
    return image[0], depth, np.ones((240, 320), bool), image[1]


# ---------------------------------------------------------------- weights
def test_the_shipped_weights_load() -> None:
    assert WEIGHTS.stat().st_size < 5e6
    net = load_scale_vit(WEIGHTS)
    assert not net.training
    assert all(value.dtype == torch.float32 for value in net.state_dict().values())


def spoilt(tmp_path: Path, change: str) -> Path:
    state = load_file(WEIGHTS)
    name = "stem.first.weight"
    if change == "missing":
        del state[name]
    elif change == "unknown":
        state["stem.sixth.weight"] = state[name]
    elif change == "another shape":
        state[name] = state[name][:4].contiguous()
    elif change == "not finite":
        state[name][0] = float("nan")
    path = tmp_path / "scale_vit.safetensors"
    save_file({key: value.clone() for key, value in state.items()}, path)
    return path


@pytest.mark.parametrize("change", ["missing", "unknown", "another shape", "not finite"])
def test_other_weights_are_refused(tmp_path: Path, change: str) -> None:
    path = spoilt(tmp_path, change)
    with pytest.raises(WeightsError, match=change) as caught:
        load_scale_vit(path)
    assert str(path) in str(caught.value) and "stem." in str(caught.value)


def test_no_file_and_no_safetensors(tmp_path: Path) -> None:
    path = tmp_path / "scale_vit.safetensors"
    with pytest.raises(WeightsError, match=str(path)):
        LearnedLength(path)
    path.write_bytes(b"nothing of the kind")
    with pytest.raises(WeightsError, match=str(path)):
        LearnedLength(path)


# ---------------------------------------------------------------- the network
def test_shapes() -> None:
    net, images = ScaleVit().eval(), torch.rand(3, 3, SIDE, SIDE)
    with torch.inference_mode():
        out = net(images, images.flip(0))
    tokens = GRID * GRID
    assert GRID * STRIDE == SIDE and positions().shape == (tokens, 6)
    assert out.rotation.shape == (3, 3, 3) and out.direction.shape == (3, 3)
    assert out.log_length.shape == (3,) and out.log_attention.shape == (3, 2, tokens, tokens)
    assert out.found.shape == (3, tokens, 2) and out.log_depth.shape == (3, tokens)
    assert torch.allclose(out.direction.norm(dim=1), torch.ones(3), atol=1e-3)
    assert torch.allclose(out.log_attention.exp().sum(3), torch.ones(1), atol=1e-4)
    identity = out.rotation @ out.rotation.transpose(1, 2)
    assert torch.allclose(identity, torch.eye(3).expand(3, 3, 3), atol=1e-4)


def test_motion_from_exact_places() -> None:
    torch.manual_seed(0)
    places = positions()[:, :2] / 2
    inverse_depth = torch.rand(4, len(places)) + 0.5
    rotation, translation = rotation_matrices(0.08 * torch.randn(4, 3)), 0.08 * torch.randn(4, 3)
    rays = torch.cat([places, torch.ones(len(places), 1)], 1)
    y = rays @ rotation.transpose(1, 2) + inverse_depth[..., None] * translation[:, None]
    weights = torch.full((4, len(places)), 1 / len(places))
    R, t = solve_motion(places, inverse_depth, y[..., :2] / y[..., 2:], weights, 5)
    assert torch.allclose(R, rotation, atol=1e-4) and torch.allclose(t, translation, atol=1e-4)


def test_positions_are_those_of_the_tokens_middles() -> None:
    pixels = np.stack(np.meshgrid(np.arange(SIDE), np.arange(SIDE)), -1).reshape(-1, 2)
    rays = bearings(CAMERA, pixels.astype(np.float32))[:, :2].reshape(GRID, STRIDE, GRID, STRIDE, 2)
    middles = rays.mean((1, 3)).reshape(-1, 2)
    assert np.allclose(positions()[:, :2].numpy() / 2, middles, atol=1e-5)


# ---------------------------------------------------------------- what the network sees
@pytest.mark.parametrize(
    "camera",
    [PHOTO, Camera(1280, 960, 1100.0, 1080.0, 640.0, 470.0), Camera(90, 80, 60, 62, 44, 41)],
)
def test_any_camera_is_brought_to_the_networks_own(camera: Camera) -> None:
    """A disc at a known ray stays there."""
    ray = np.array([0.12, -0.09])
    u, v = camera.fx * ray[0] + camera.cx, camera.fy * ray[1] + camera.cy
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    disc = np.hypot((x - u) / camera.fx, (y - v) / camera.fy) < 0.06
    image = np.where(disc[..., None], np.uint8(255), np.uint8(0)).repeat(3, 2)
    seen = as_seen_by_network(camera, image)[..., 0].astype(float)
    assert seen.shape == (SIDE, SIDE)
    row, column = np.indices(seen.shape)
    middle = np.array([(column * seen).sum(), (row * seen).sum()]) / seen.sum()
    wanted = CAMERA.fx * ray + [CAMERA.cx, CAMERA.cy]
    assert np.abs(middle - wanted).max() < 0.4


def test_a_narrow_view_has_black_borders() -> None:
    white = np.full((200, 200, 3), 255, np.uint8)
    seen = as_seen_by_network(Camera(200, 200, 400, 400, 99.5, 99.5), white)
    assert seen[48, 48].min() == 255 and seen[0].max() == 0 and seen[:, -1].max() == 0


# ---------------------------------------------------------------- the length
@pytest.mark.parametrize("unit", [0.01, 1.0, 250.0])
def test_the_length_has_the_maps_unit(length: LearnedLength, unit: float) -> None:
    render, depth, covered, image = random_pair()
    one = length(PHOTO, render, depth, covered, image)
    assert one > 0
    other = length(PHOTO, render, np.float32(unit) * depth, covered, image)
    assert other == pytest.approx(unit * one, rel=1e-5)


def test_results_repeat_themselves(length: LearnedLength) -> None:
    pair = random_pair()
    assert length(PHOTO, *pair) == length(PHOTO, *pair)


def test_a_view_of_nothing_has_no_length(length: LearnedLength) -> None:
    render, depth, covered, image = random_pair()
    assert np.isnan(length(PHOTO, render, depth, np.zeros_like(covered), image))


def test_only_covered_depths_count(length: LearnedLength) -> None:
    render, depth, covered, image = random_pair()
    covered[:, ::2] = False
    one = length(PHOTO, render, depth, covered, image)
    depth[~covered] = 1e6
    assert length(PHOTO, render, depth, covered, image) == one


def test_it_has_learned_of_maps_that_it_never_saw() -> None:
    """Far from chance: a random direction is 90 degrees off, no rotation at all 5."""
    made = [views_of(make(3_000_000 + seed), 16, np.random.default_rng(seed))
            for seed, make in enumerate((make_room, make_object))]  # fmt: skip
    errors = validate(load_scale_vit(WEIGHTS), all_pairs(join(made), 0))
    assert errors["direction_deg"] < 50 and errors["rotation_deg"] < 4.2
    assert errors["scale"] < 0.45


# ---------------------------------------------------------------- in the paper's solver
def test_the_choice_is_in_the_configuration() -> None:
    assert Config.from_flat({"refine.scale": "vit"}).refine.scale == "vit"
    with pytest.raises(ConfigError, match="depth, vit"):
        Config.from_flat({"refine.scale": "guess"})


def _matched(motion: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    uv = rng.uniform([0, 0], [319, 239], (200, 2)).astype(np.float32)
    z = rng.uniform(1, 4, 200)
    turn = rotation_from_vector([0.02, -0.05, 0.01])
    x = transform_points(compose(turn, motion), bearings(PHOTO, uv) * z[:, None])
    moved = x[:, :2] / x[:, 2:] * [PHOTO.fx, PHOTO.fy] + [PHOTO.cx, PHOTO.cy]
    return uv, moved.astype(np.float32), z.astype(np.float32)


def test_solve_relative_takes_the_networks_length(length: LearnedLength) -> None:
    render, depth, covered, image = random_pair()
    pair = scales.ImagePair(PHOTO, image, render, depth, covered)
    uv, moved, z = _matched(np.array([0.2, -0.1, 0.1]))
    solution = solve_relative(
        PHOTO, uv, moved, z, np.eye(4), 1.0, 1e3, scales.SCALES["vit"]()(pair)
    )
    assert solution is not None
    wanted = length(PHOTO, render, depth, covered, image)
    assert np.linalg.norm(solution.T_scene_cam[:3, 3]) == pytest.approx(wanted, rel=1e-6)


def test_a_pair_without_parallax_never_asks_the_network(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> float:
        raise AssertionError("asked")

    monkeypatch.setattr(LearnedLength, "__call__", refuse)
    pair = scales.ImagePair(PHOTO, *(random_pair()[i] for i in (3, 0, 1, 2)))
    estimate = scales.SCALES["vit"]()(pair)
    uv, moved, z = _matched(np.zeros(3))
    solution = solve_relative(PHOTO, uv, moved, z, np.eye(4), 1.0, 3.0, estimate)
    assert solution is not None and np.linalg.norm(solution.T_scene_cam[:3, 3]) < 1e-9
    with pytest.raises(AssertionError, match="asked"):
        solve_relative(PHOTO, *_matched(np.array([0.2, 0, 0])), np.eye(4), 1.0, 3.0, estimate)


def test_the_refiner_asks_the_network(
    room_igmap: Path, localizer: Localizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[float] = []
    answer = LearnedLength.__call__

    def listen(self: LearnedLength, *arguments: object) -> float:
        asked.append(answer(self, *arguments))  # type: ignore[arg-type]
        return asked[-1]

    monkeypatch.setattr(LearnedLength, "__call__", listen)
    config = Config(refine=RefineConfig(solver="paper", scale="vit"))
    paper = Localizer.open(room_igmap, config)
    camera = Camera(320, 240, 250.0, 250.0, 159.5, 119.5)
    T_true = paper.T_map_scene.camera(rooms.source_poses()[3])
    prior = T_true @ compose(np.eye(3), [0.1, 0.0, 0.02])
    rgb, _, _ = localizer.render(camera, T_true)
    image = (255 * np.clip(rgb, 0, 1)).astype(np.uint8)
    result = paper.localize(image, camera, prior)
    assert asked and all(0 < value < 1 for value in asked)
    if result.ok:  # the length may be wrong; the rotation and the verdict are not the network's
        assert result.T_map_cam is not None
        angle, distance = pose_error(result.T_map_cam, T_true)
        assert angle < 1 and distance < 0.1


def test_weights_are_not_needed_by_other_scales(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scales, "LearnedLength", None)
    assert callable(scales.SCALES["depth"]())


# ---------------------------------------------------------------- training
def test_pairs_know_where_tokens_went(views: Views) -> None:
    """The stored places are those of the rendered depth and the poses."""
    batch = pairs(views, np.array([0]), np.array([1]))
    T = inverse(views.T_scene_cam[1]) @ views.T_scene_cam[0]
    expected = T[:3, 3] / views.medians[0]
    assert np.allclose(batch.translation[0].numpy(), expected, atol=1e-5)
    seen = batch.weights[0].sum(1) > 0
    assert seen.float().mean() > 0.3
    # shares of four tokens around a place: their mean is the place
    tokens = positions()[:, :2][batch.targets[0]] / 2
    mean = (tokens * batch.weights[0][..., None]).sum(1)
    inside = batch.places[0].abs().amax(1) < 0.38
    assert (mean - batch.places[0])[seen & inside].abs().max() < 0.01


def test_batches_repeat_themselves(views: Views) -> None:
    first, second = (next(batches(views, 4, range(7, 8), 1)) for _ in range(2))
    assert torch.equal(first.b, second.b) and torch.equal(first.translation, second.translation)
    other = next(batches(views, 4, range(8, 9), 1))
    assert not torch.equal(first.b, other.b)


def test_views_of_a_place_are_as_far_apart_as_stage_one_errs(views: Views) -> None:
    assert len(views) == 6 * VIEWS and (views.medians > 0).all()
    for first in range(0, len(views), VIEWS):
        for other in range(first + 1, first + VIEWS):
            angle, distance = pose_error(views.T_scene_cam[other], views.T_scene_cam[first])
            assert angle <= 10.01 and distance <= 0.1501 * views.medians[first]


def test_the_loss_is_small_for_the_truth(views: Views) -> None:
    batch = next(batches(views, 4, range(1), 0))
    net = ScaleVit()
    parts = loss_of(net(batch.a, batch.b), batch)
    assert set(parts) == {
        "rotation", "direction", "length", "translation", "attention", "place", "depth",
    }  # fmt: skip
    torch.stack(list(parts.values())).sum().backward()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in net.parameters())


def test_a_stopped_training_goes_on_as_if_it_had_not(tmp_path: Path) -> None:
    torch.set_num_threads(1)
    options = ScaleTraining(
        maps=1, places=2, held_out_maps=1, held_out_places=2, steps=4, batch=2, every=2, seed=9
    )
    stages: list[str] = []
    train_scale_vit(tmp_path / "a", options, progress=lambda stage, done, of: stages.append(stage))
    assert {"training"} < set(stages)
    train_scale_vit(tmp_path / "b", options, minutes=0)
    assert torch.load(tmp_path / "b/state.pt", weights_only=True)["step"] == 1
    train_scale_vit(tmp_path / "b", options)
    whole, parts = (load_file(tmp_path / name / "scale_vit.safetensors") for name in "ab")
    assert all(torch.equal(whole[name], parts[name]) for name in whole)
    load_scale_vit(tmp_path / "a/scale_vit.safetensors")
    assert (tmp_path / "a/curves.png").stat().st_size > 1000
    with pytest.raises(WeightsError, match="state.pt"):
        train_scale_vit(tmp_path / "b", replace(options, batch=3))


def test_a_camera_looks_where_a_pose_says(views: Views) -> None:
    """Poses are T_scene_cam: the place's first view looks into the room."""
    T = views.T_scene_cam[0]
    assert np.allclose(T, look_at(T[:3, 3], T[:3, 3] + T[:3, 2], -T[:3, 1]), atol=1e-6)
