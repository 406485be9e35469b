"""The photo track: real images with known poses, held out from the map's training."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from igaussian_core.errors import DatasetError
from igaussian_core.evaluate.metrics import QueryOutcome, outcome
from igaussian_core.localizer import Localizer
from igaussian_core.posed_images import PosedImage, read_posed_images


def held_out_images(
    poses: str | Path, map_note: str | Path | None, allow_training: bool = False
) -> list[PosedImage]:
    """Posed images that exist and that the map was not trained on.

    Args:
        map_note: the map's `map.json`, which names `trained_on` and `heldout`; None: found
            beside the pose file.

    Raises:
        DatasetError: no list of training photos (and not allow_training), or nothing is left.
    """
    images = [image for image in read_posed_images(poses) if image.path.is_file()]
    note = Path(map_note) if map_note else _beside(Path(poses)) / "map.json"
    if not allow_training:
        if not note.is_file():
            raise DatasetError(
                f"{note}: no list of the photos that the map was trained on; accuracy on those "
                "would flatter (--allow-training judges all photos)"
            )
        trained_on = _trained_on(note)
        images = [image for image in images if image.name not in trained_on]
    if not images:
        raise DatasetError(f"{poses}: no photo with a pose is left to judge")
    return images


def _trained_on(note: Path) -> set[str]:
    try:
        return set(json.loads(note.read_text())["trained_on"])
    except (OSError, LookupError, TypeError, ValueError) as error:
        cause = f"{type(error).__name__}: {error}"
        raise DatasetError(f"{note}: names no photos under 'trained_on' ({cause})") from error


def extent(images: Sequence[PosedImage]) -> float:
    """Largest distance of a camera from the cameras' mean position, scene units."""
    positions = np.array([image.T_scene_cam[:3, 3] for image in images])
    return float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).max())


def evaluate_photos(
    localizer: Localizer,
    images: Sequence[PosedImage],
    progress: Callable[[int, int], None] = lambda done, of: None,
) -> list[QueryOutcome]:
    """Localize every image without a prior; the truth is looked at afterwards only."""
    red, green, blue = (round(255 * value) for value in localizer.manifest.background)
    outcomes = []
    for index, image in enumerate(images):
        result = localizer.localize(image.read((red, green, blue)), image.camera)
        truth = localizer.T_map_scene.camera(image.T_scene_cam)
        outcomes.append(outcome(image.name, result, truth))
        progress(index + 1, len(images))
    return outcomes


def _beside(path: Path) -> Path:
    return path if path.is_dir() else path.parent
