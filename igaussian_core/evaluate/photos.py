"""The photo track: real images with known poses, held out from the map's training."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from igaussian_core.camera import Camera
from igaussian_core.errors import DatasetError
from igaussian_core.evaluate.image_changes import Change, changed
from igaussian_core.geometry import Sim3
from igaussian_core.posed_images import PosedImage, read_posed_images

Array = NDArray[np.float64]


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
    note = Path(map_note) if map_note else folder_of(poses) / "map.json"
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


def folder_of(poses: str | Path) -> Path:
    """Where a pose file lies; a folder of poses itself."""
    path = Path(poses)
    return path if path.is_dir() else path.parent


def extent(images: Sequence[PosedImage]) -> float:
    """Largest distance of a camera from the cameras' mean position, scene units."""
    positions = np.array([image.T_scene_cam[:3, 3] for image in images])
    return float(np.linalg.norm(positions - positions.mean(axis=0), axis=1).max())


@dataclass(frozen=True)
class PhotoQueries:
    """Photos of a map's scene.

    Attributes:
        background: RGB in [0, 1], behind photos with an alpha channel.
        changes: of the images.
    """

    images: tuple[PosedImage, ...]
    T_map_scene: Sim3
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    changes: tuple[Change, ...] = ()

    def __len__(self) -> int:
        return len(self.images)

    def name(self, index: int) -> str:
        return self.images[index].name

    def group(self, index: int) -> str:
        return ""

    def image(self, index: int) -> tuple[NDArray[np.uint8], Camera]:
        red, green, blue = (round(255 * value) for value in self.background)
        photo = self.images[index]
        return changed(photo.read((red, green, blue)), self.changes, index), photo.camera

    def prior(self, index: int) -> Array | None:
        return None

    def truth(self, index: int) -> Array:
        return self.T_map_scene.camera(self.images[index].T_scene_cam)
