"""The pose attention network: what its equations promise, whatever its weights."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from igaussian_core.coarse.attention import (
    ATTENTIONS,
    PAPER,
    NetworkConfig,
    PoseNetwork,
    Prediction,
    SourceViews,
)

CONFIGS = [
    NetworkConfig(attention=attention, lookup=lookup, relative=relative)
    for attention in ATTENTIONS for lookup in (True, False) for relative in (True, False)
]  # fmt: skip
CONFIGS.append(PAPER)


def network(config: NetworkConfig) -> PoseNetwork:
    torch.manual_seed(1)
    made = PoseNetwork(config).eval()
    for parameter in made.parameters():  # nothing stays at its zero
        if not parameter.any():
            torch.nn.init.normal_(parameter, 0, 0.05)
    return made


def views(made: PoseNetwork, count: int, maps: int = 1, seed: int = 0) -> SourceViews:
    random = torch.Generator().manual_seed(seed)
    q, _ = torch.linalg.qr(torch.randn(maps, count, 3, 3, generator=random))
    rotation = q * torch.linalg.det(q)[..., None, None]
    return SourceViews(
        features=torch.randn(maps, count, made.backbone.channels, 4, 6, generator=random),
        points=torch.randn(maps, count, 4, 6, 3, generator=random),
        known=torch.rand(maps, count, 4, 6, generator=random) < 0.9,
        rotation=rotation,
        position=torch.randn(maps, count, 3, generator=random),
    )


def images(count: int, seed: int = 5) -> torch.Tensor:
    return torch.rand(count, 3, 64, 96, generator=torch.Generator().manual_seed(seed))


RAYS = torch.rand(1, 4, 6, 2, generator=torch.Generator().manual_seed(3))


@torch.inference_mode()
def predict(made: PoseNetwork, of: SourceViews, count: int = 2) -> Prediction:
    return made(images(count), RAYS.expand(len(of.features), -1, -1, -1), of)


@pytest.mark.parametrize("config", CONFIGS, ids=str)
def test_poses_are_rigid_and_weights_sum_to_one(config: NetworkConfig) -> None:
    made = network(config)
    p = predict(made, views(made, 5))
    assert p.candidate_rotations.shape == (2, 5, 3, 3) and p.position.shape == (2, 3)
    assert p.points.shape == (2, 4, 6, 3)
    for rotation in (p.rotation, p.candidate_rotations):
        eye = rotation @ rotation.transpose(-1, -2)
        assert torch.allclose(eye, torch.eye(3).expand_as(eye), atol=1e-5)
        assert torch.allclose(torch.linalg.det(rotation), torch.ones(()), atol=1e-5)
    assert torch.allclose(p.log_weights.exp().sum(1), torch.ones(2), atol=1e-5)


@pytest.mark.parametrize("config", CONFIGS, ids=str)
def test_the_order_of_the_source_views_does_not_matter(config: NetworkConfig) -> None:
    made = network(config)
    of = views(made, 5)
    order = torch.tensor([3, 0, 4, 1, 2])
    a, b = predict(made, of), predict(made, SourceViews(*(part[:, order] for part in of)))
    assert torch.allclose(a.rotation, b.rotation, atol=1e-4)
    assert torch.allclose(a.position, b.position, atol=1e-4)
    assert torch.allclose(a.candidate_positions[:, order], b.candidate_positions, atol=1e-4)
    assert torch.allclose(a.log_weights[:, order], b.log_weights, atol=1e-4)


@pytest.mark.parametrize("config", CONFIGS, ids=str)
def test_maps_of_one_batch_do_not_mix(config: NetworkConfig) -> None:
    made = network(config)
    both = views(made, 4, maps=2, seed=8)
    together = predict(made, both, 4)
    second = SourceViews(*(part[1:] for part in both))
    with torch.inference_mode():
        alone = made(images(4)[2:], RAYS, second)
    assert torch.allclose(together.position[2:], alone.position, atol=1e-4)
    assert torch.allclose(together.points[2:], alone.points, atol=1e-4)


@pytest.mark.parametrize("config", [c for c in CONFIGS if c.attention != "none"], ids=str)
def test_the_source_poses_matter(config: NetworkConfig) -> None:
    made = network(config)
    of = views(made, 4)
    turned = of._replace(position=of.position + 1.0)
    difference = (predict(made, of).position - predict(made, turned).position).norm(dim=-1)
    assert (difference > 1e-3).all()


def test_without_the_wpm_all_candidates_count_alike() -> None:
    made = network(NetworkConfig(weights=False))
    p = predict(made, views(made, 5))
    assert torch.allclose(p.log_weights.exp(), torch.full((2, 5), 0.2))
    assert torch.allclose(p.position, p.candidate_positions.mean(1), atol=1e-5)


def test_cells_that_resemble_a_source_view_are_told_its_place() -> None:
    """With the source view's features the target's own, the lookup finds the same cells."""
    made = network(NetworkConfig())
    with torch.no_grad():
        made.compare_source.load_state_dict(made.compare_target.state_dict())
        made.log_sharpness.fill_(8.0)
    with torch.inference_mode():
        features = made.backbone(images(1))
        of = views(made, 3)
        own = torch.stack([features[0], *of.features[0, 1:]])[None]
        seen, evidence, resemblance = made._look_up(
            features, of._replace(features=own, known=torch.ones(1, 3, 4, 6, dtype=torch.bool))
        )
    assert torch.allclose(seen[0], of.points[0, 0].reshape(-1, 3), atol=0.05)
    assert (evidence[0, :, 1] > -0.1).all()
    assert torch.allclose(resemblance.exp().sum(-1), torch.ones(1, 24), atol=1e-4)


def test_configurations_are_plain_values() -> None:
    assert NetworkConfig(**dataclasses.asdict(NetworkConfig(width=64))).width == 64
