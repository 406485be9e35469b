"""Kernel regression among views of known pose."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from igaussian_core.camera import Camera
from igaussian_core.coarse.memory import Recall, ViewMemory, _agreeing, fit_memory, raw_keys
from igaussian_core.errors import MapError
from igaussian_core.geometry import is_rigid, rotation_from_vector

CAMERA = Camera(32, 32, 40.0, 40.0, 15.5, 15.5)


def views(count: int, seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Features [N, C, 4, 4] that depend smoothly on a pose, and that pose."""
    rng = np.random.default_rng(seed)
    vectors, positions = rng.uniform(-1, 1, (2, count, 3))
    mix = np.random.default_rng(99).normal(size=(6, 40))
    waves = np.tanh(np.concatenate([vectors, positions], 1) @ mix)
    features = torch.tensor(waves).float()[:, :, None, None].expand(-1, -1, 4, 4)
    rotations = np.array([rotation_from_vector(v) for v in vectors])
    return features, torch.tensor(rotations).float(), torch.tensor(positions).float()


def similarity_to(memory: ViewMemory, features: torch.Tensor) -> torch.Tensor:
    return Recall(memory, torch.nn.Identity(), CAMERA).similarity(features)


@pytest.fixture(scope="module")
def memory() -> ViewMemory:
    features, rotations, positions = views(1500, 0)
    return fit_memory(raw_keys(features), rotations, positions, 32)


def test_poses_of_views_that_it_never_saw(memory: ViewMemory) -> None:
    features, rotations, positions = views(100, 1)
    found_rotations, found_positions = memory.regressed(similarity_to(memory, features))
    assert np.median(np.linalg.norm(found_positions - positions.numpy(), axis=1)) < 0.05
    cosine = np.einsum("nij,nij->n", found_rotations, rotations.numpy())
    assert np.degrees(np.arccos(np.clip((np.median(cosine) - 1) / 2, -1, 1))) < 3
    for rotation, position in zip(found_rotations, found_positions, strict=True):
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = rotation, position
        assert is_rigid(T)


def test_it_knows_the_views_that_it_keeps(memory: ViewMemory) -> None:
    features, rotations, positions = views(1500, 0)
    similarity = similarity_to(memory, features[:50])
    assert (similarity.argmax(1) == torch.arange(50)).all()
    assert similarity.min() >= 0 and similarity.max() <= 1 + 1e-5
    rotation, position = memory.pose_of(7)
    assert np.allclose(rotation, rotations[7], atol=1e-5)
    assert np.allclose(position, positions[7], atol=1e-6)


def test_what_resembles_nothing_gets_a_pose_all_the_same(memory: ViewMemory) -> None:
    similarity = similarity_to(memory, 1e3 * torch.ones(1, 40, 4, 4))
    rotations, positions = memory.regressed(similarity)
    assert similarity.max() < 1e-3
    assert is_rigid(np.block([[rotations[0], positions[0][:, None]], [np.zeros((1, 3)), 1]]))


class Tint(torch.nn.Module):
    """A backbone that sees the mean colour only, so that every turn of a plain image is alike."""

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return images.mean((2, 3), keepdim=True).repeat(1, 1, 2, 2)


def test_answers_of_turned_images_are_turned_back_and_averaged() -> None:
    """Positions follow colour; the camera's turns, which no colour shows, cancel."""
    colours = torch.rand(400, 3, generator=torch.Generator().manual_seed(0))
    keys = raw_keys(Tint()(colours[:, :, None, None].expand(-1, -1, 8, 8)))
    memory = fit_memory(keys, torch.eye(3).expand(400, 3, 3), colours, 8)
    image = np.full((32, 32, 3), (51, 102, 153), np.uint8)
    recalled = Recall(memory, Tint(), CAMERA)(image)
    assert np.allclose(recalled.position, [0.2, 0.4, 0.6], atol=0.03)
    assert np.degrees(np.arccos((np.trace(recalled.rotation) - 1) / 2)) < 1.0
    assert recalled.similarity.shape == (400,)


def test_an_answer_far_from_the_others_is_left_out() -> None:
    rotations = np.array([rotation_from_vector([0.01 * i, 0, 0]) for i in range(7)])
    positions = np.zeros((7, 3))
    rotations[4], positions[4] = rotation_from_vector([0, 2.5, 0]), (3, 0, 0)
    assert _agreeing(rotations, positions).tolist() == [True] * 4 + [False] + [True] * 2
    assert _agreeing(rotations[:1].repeat(7, 0), positions[:7] * 0).all()


def test_views_all_alike() -> None:
    same = torch.ones(20, 40)
    rotations = torch.eye(3).expand(20, 3, 3)
    memory = fit_memory(same, rotations, torch.arange(60.0).reshape(20, 3), 8)
    _, positions = memory.regressed(similarity_to(memory, torch.ones(1, 10, 2, 2)))
    assert np.allclose(positions[0], [28.5, 29.5, 30.5], atol=0.1)


def test_features_that_are_not_finite_are_refused() -> None:
    raw = torch.ones(8, 4)
    raw[3, 2] = torch.nan
    with pytest.raises(MapError, match="not finite"):
        fit_memory(raw, torch.eye(3).expand(8, 3, 3), torch.zeros(8, 3))
