"""Kernel regression among views of known pose."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from igaussian_core.coarse.memory import ViewMemory, fit_memory, raw_keys
from igaussian_core.errors import MapError
from igaussian_core.geometry import is_rigid, rotation_from_vector


def views(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Features [N, C, 4, 4] that depend smoothly on a pose, and that pose."""
    rng = np.random.default_rng(seed)
    vectors, positions = rng.uniform(-1, 1, (2, count, 3))
    mix = np.random.default_rng(99).normal(size=(6, 40))
    waves = np.tanh(np.concatenate([vectors, positions], 1) @ mix)
    features = torch.tensor(waves).float()[:, :, None, None].expand(-1, -1, 4, 4)
    rotations = np.array([rotation_from_vector(v) for v in vectors])
    return features, torch.tensor(rotations).float(), torch.tensor(positions).float()


@pytest.fixture(scope="module")
def memory() -> ViewMemory:
    features, rotations, positions = views(1500, 0)
    return fit_memory(raw_keys(features), rotations, positions, 32)


def test_poses_of_views_that_it_never_saw(memory: ViewMemory) -> None:
    features, rotations, positions = views(100, 1)
    found_rotations, found_positions = memory.regressed(memory.similarity(features))
    assert np.median(np.linalg.norm(found_positions - positions.numpy(), axis=1)) < 0.05
    cosine = np.einsum("nij,nij->n", found_rotations, rotations.numpy())
    assert np.degrees(np.arccos(np.clip((np.median(cosine) - 1) / 2, -1, 1))) < 3
    for rotation, position in zip(found_rotations, found_positions, strict=True):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotation, position
        assert is_rigid(T)


def test_it_knows_the_views_that_it_keeps(memory: ViewMemory) -> None:
    features, rotations, positions = views(1500, 0)
    similarity = memory.similarity(features[:50])
    assert (similarity.argmax(1) == torch.arange(50)).all()
    assert similarity.min() >= 0 and similarity.max() <= 1 + 1e-5
    rotation, position = memory.pose_of(7)
    assert np.allclose(rotation, rotations[7], atol=1e-5)
    assert np.allclose(position, positions[7], atol=1e-6)


def test_what_resembles_nothing_gets_a_pose_all_the_same(memory: ViewMemory) -> None:
    similarity = memory.similarity(1e3 * torch.ones(1, 40, 4, 4))
    rotations, positions = memory.regressed(similarity)
    assert similarity.max() < 1e-3
    assert is_rigid(np.block([[rotations[0], positions[0][:, None]], [np.zeros((1, 3)), 1]]))


def test_views_all_alike() -> None:
    same = torch.ones(20, 40)
    rotations = torch.eye(3).expand(20, 3, 3)
    memory = fit_memory(same, rotations, torch.arange(60.0).reshape(20, 3), 8)
    _, positions = memory.regressed(memory.similarity(torch.ones(1, 10, 2, 2)))
    assert np.allclose(positions[0], [28.5, 29.5, 30.5], atol=0.1)


def test_features_that_are_not_finite_are_refused() -> None:
    raw = torch.ones(8, 4)
    raw[3, 2] = torch.nan
    with pytest.raises(MapError, match="not finite"):
        fit_memory(raw, torch.eye(3).expand(8, 3, 3), torch.zeros(8, 3))
