"""Joint training by episodes: its closed form, its neighbours, its losses, and that it teaches."""

from __future__ import annotations

from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np
import pytest
import torch

from igaussian_core.coarse.attention import NetworkConfig, PoseNetwork
from igaussian_core.coarse.memory import matern
from igaussian_core.geometry import rotation_angle_deg
from igaussian_core.training.episodes import (
    EpisodeMap,
    EpisodeOptions,
    EpisodeTrainer,
    MemoryTrainer,
    leave_one_out,
    leave_one_out_errors,
    place_loss,
    pose_differences,
)
from igaussian_core.training.joint import (
    ComingMaps,
    JointTrainer,
    _made,
    _Parts,
    procedural_views,
)


@pytest.fixture(scope="module")
def maps() -> list[EpisodeMap]:
    """A room and an object."""
    return [procedural_views(seed, count=96) for seed in (0, 1)]


def test_a_map_of_a_training_never_shows_a_view_twice(maps: list[EpisodeMap]) -> None:
    for of in maps:
        poses = of.views.poses
        apart = torch.cdist(poses, poses) + torch.eye(len(poses))
        assert float(apart.min()) > 1e-6


def test_two_thirds_of_a_map_s_views_are_near_one_another(maps: list[EpisodeMap]) -> None:
    for of in maps:
        views = of.views
        anywhere, *near = [
            float(np.median([
                pose_differences(part.rotation, part.position, i, of.lambda_t).median()
                for i in range(32)
            ]))
            for part in (views.at(np.arange(k, k + 32)) for k in (0, 32, 64))
        ]  # fmt: skip
        assert max(near) < 0.6 * anywhere


def test_maps_come_in_the_order_of_their_seeds_however_soon_they_are_there() -> None:
    late, soon = Future[_Parts](), Future[_Parts]()
    soon.set_result(_made(1, count=9))
    coming = ComingMaps([late, soon], "cpu")
    assert len(coming) == 2
    with ThreadPoolExecutor(1) as waiting:
        asked = waiting.submit(coming.first, 1)
        late.set_result(_made(0, count=9))
        (first,) = asked.result(timeout=60)
    expected = procedural_views(0, count=9)
    assert torch.equal(first.views.rgba, expected.views.rgba)
    assert torch.equal(first.background, expected.background)
    assert coming.first(2)[1].lambda_t == procedural_views(1, count=9).lambda_t


def test_all_maps_are_in_use_after_half_of_the_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("igaussian_core.training.joint._AT_FIRST", 2)
    made: list[Future[_Parts]] = [Future() for _ in range(7)]
    for seed, future in enumerate(made):
        future.set_result(_made(seed % 2, count=9))
    options = EpisodeOptions(steps=8, views=9)
    network = PoseNetwork(NetworkConfig(width=64))
    trainer = JointTrainer(network, ComingMaps(made, "cpu"), 1, options, None, 1, "cpu")
    used = []
    for trainer.step in range(8):
        used.append(len(trainer._known()))
    assert used == [2, 3, 4, 5, 6, 6, 6, 6]


def test_leaving_one_out_is_what_a_regression_without_it_says() -> None:
    random = torch.Generator().manual_seed(0)
    keys = torch.randn(20, 3, generator=random, dtype=torch.float64)
    poses = torch.randn(20, 12, generator=random, dtype=torch.float64)
    found = leave_one_out(keys, poses)
    distances = (torch.cdist(keys, keys).square() + 1e-6).sqrt()
    gram = matern(distances.clone(), distances.median()) + 0.02 * torch.eye(20)
    mean = poses.mean(0)
    for left in range(20):
        others = [i for i in range(20) if i != left]
        weights = torch.linalg.solve(gram[others][:, others], gram[others, left])
        assert torch.allclose(found[left], mean + weights @ (poses[others] - mean), atol=1e-6)


def test_leaving_one_out_sends_gradients_to_all_keys() -> None:
    keys = torch.randn(12, 4, generator=torch.Generator().manual_seed(0)).requires_grad_()
    leave_one_out(keys, torch.eye(12)).square().sum().backward()
    assert keys.grad is not None and torch.isfinite(keys.grad).all()
    assert (keys.grad.abs().sum(1) > 0).all()


def test_the_nearest_views_look_the_same_way(maps: list[EpisodeMap]) -> None:
    for of in maps:
        turns = of.views.rotation.double().numpy()
        orders = [of.nearest(i) for i in range(96)]
        near, far = [
            np.mean([rotation_angle_deg(turns[i].T @ turns[order[k]])
                     for i, order in enumerate(orders)])
            for k in (1, -1)
        ]  # fmt: skip
        assert [order[0] for order in orders] == list(range(96))
        assert near < 0.5 * far


def test_cells_that_show_the_same_place_are_to_be_alike(maps: list[EpisodeMap]) -> None:
    random = torch.Generator().manual_seed(0)
    views = maps[1].views
    # features that are a smooth function of the place
    lift = torch.randn(3, 64, generator=random)
    telling = torch.cos(3 * views.points @ lift).permute(0, 3, 1, 2)
    silent = torch.randn(telling.shape, generator=random)
    good, bad = (
        float(place_loss(f, views, torch.Generator().manual_seed(1))) for f in (telling, silent)
    )
    assert good < bad - 0.5


def test_cells_that_show_nothing_cost_nothing(maps: list[EpisodeMap]) -> None:
    views = maps[0].views
    blind = views._replace(known=torch.zeros_like(views.known))
    features = torch.ones(len(views.rgba), 8, 8, 8, requires_grad=True)
    loss = place_loss(features, blind, torch.Generator())
    loss.backward()
    assert float(loss.detach()) == 0


def test_episodes_teach_what_other_views_tell(maps: list[EpisodeMap]) -> None:
    torch.manual_seed(0)
    network = PoseNetwork(NetworkConfig(width=64)).eval()
    before = [float(leave_one_out_errors(network, of)[0].median()) for of in maps]
    options = EpisodeOptions(steps=48, views=32, learning_rate=2e-3, validate_every=24)
    trainer = EpisodeTrainer(network, maps, maps, options)
    curve = trainer.run()
    after = [float(leave_one_out_errors(trainer.network, of)[0].median()) for of in maps]
    assert np.mean(after) < 0.8 * np.mean(before)
    assert curve.steps == [24, 48] and np.isfinite(curve.values["loss"]).all()
    assert set(curve.values) == {"loss", "degrees", "lengths", "within_15", "learning_rate"}


def test_a_map_teaches_what_its_own_views_tell(maps: list[EpisodeMap]) -> None:
    torch.manual_seed(0)
    of = maps[1]
    known, held_out = of._replace(views=of.views.at(np.arange(80))), of.views.at(np.arange(80, 96))
    options = EpisodeOptions(steps=24, views=32, learning_rate=2e-3, validate_every=12)
    trainer = MemoryTrainer(PoseNetwork(NetworkConfig(width=64)), known, held_out, options)
    curve = trainer.run()
    losses = curve.values["loss"]
    assert curve.steps == [12, 24] and losses[1] < losses[0]
    assert np.isfinite(curve.values["degrees"]).all()
