"""Joint training by episodes: its closed form, its neighbours, its losses, and that it teaches."""

from __future__ import annotations

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
)
from igaussian_core.training.joint import procedural_views


@pytest.fixture(scope="module")
def maps() -> list[EpisodeMap]:
    """A room and an object."""
    return [procedural_views(seed, count=96) for seed in (0, 1)]


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
