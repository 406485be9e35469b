"""Photos are judged only where the map was not trained on them."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import room

from igaussian_core.errors import DatasetError
from igaussian_core.evaluate.photos import PhotoQueries, extent, held_out_images
from igaussian_core.evaluate.runner import run
from igaussian_core.gaussian_map import GaussianMap
from igaussian_core.localizer import Localizer
from igaussian_core.posed_images import read_posed_images

POSES = room.query_poses(4, seed=22)


@pytest.fixture
def photos(tmp_path: Path, room_map: GaussianMap) -> Path:
    """poses.json of four photos, the last of which does not exist."""
    for i, T in enumerate(POSES[:3]):
        cv2.imwrite(str(tmp_path / f"{i}.png"), room.photo(room_map, T)[..., ::-1])
    return room.write_poses(tmp_path / "poses.json", POSES)


def names(poses: Path, note: Path | None = None, allow: bool = False) -> list[str]:
    return [image.name for image in held_out_images(poses, note, allow)]


def test_training_photos_are_left_out(photos: Path, tmp_path: Path) -> None:
    note = tmp_path / "map.json"
    note.write_text(json.dumps({"trained_on": ["0.png", "2.png"]}))
    assert names(photos) == names(photos.parent) == ["1.png"]
    elsewhere = tmp_path / "other.json"
    elsewhere.write_text(json.dumps({"trained_on": ["1.png"]}))
    assert names(photos, elsewhere) == ["0.png", "2.png"]
    assert names(photos, allow=True) == ["0.png", "1.png", "2.png"]


def test_without_a_list_nothing_is_judged(photos: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="would flatter"):
        held_out_images(photos, None)
    (tmp_path / "map.json").write_text(json.dumps({"trained_on": ["0.png", "1.png", "2.png"]}))
    with pytest.raises(DatasetError, match="no photo"):
        held_out_images(photos, None)


@pytest.mark.parametrize(
    "text", ["", "[", "[]", "3", "{}", '{"heldout": ["1.png"]}', '{"trained_on": 3}']
)
def test_an_unreadable_list_is_named(photos: Path, tmp_path: Path, text: str) -> None:
    (tmp_path / "map.json").write_text(text)
    with pytest.raises(DatasetError, match=r"map\.json"):
        held_out_images(photos, None)


def test_extent(photos: Path) -> None:
    positions = np.array([T[:3, 3] for T in POSES])
    largest = max(np.linalg.norm(p - positions.mean(axis=0)) for p in positions)
    assert extent(read_posed_images(photos)) == pytest.approx(largest)


def test_photos_are_localized_and_compared(photos: Path, localizer: Localizer) -> None:
    steps: list[tuple[int, int]] = []
    images = held_out_images(photos, None, allow_training=True)
    queries = PhotoQueries(tuple(images), localizer.T_map_scene)
    outcomes = run(lambda: localizer, queries, progress=lambda *s: steps.append(s)).outcomes
    assert [o.name for o in outcomes] == ["0.png", "1.png", "2.png"]
    assert steps == [(0, 3), (1, 3), (2, 3), (3, 3)]
    assert all(o.angle_deg < 0.15 and o.distance < 0.004 for o in outcomes)
