"""Does the verdict hold? Images that must be refused, images that must not, and the ROC.

Against each map of the photo benchmark, from nothing (and, for photos of other scenes, also with a
prior as when tracking):

- photos of other scenes, black, white and noise images: every accepted one is wrong;
- the map's held-out photos half covered, heavily blurred, mirrored: wrong where accepted more than
  5 degrees or 5 % of the extent off;
- the held-out photos themselves, and after changes of exposure, gamma, JPEG, blur: recall.

The ROC moves a threshold on the result's `confidence`, which the verdict puts at 0.5: the share of
usable photos that are right with as much, against the share of the other images that are not right
with as much. A refused image has no pose, so one of the map's own scene counts as not right.

    python benchmarks/verdict.py [--json out.json] [--roc roc.png] [--work folder] [--photos 8]
        [--set refine.matcher=xfeat ...]
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from _data import data_folder
from _facts import facts
from numpy.typing import NDArray
from photos import CASES, compiled
from tables import verdict

from igaussian_core.camera import Camera
from igaussian_core.cli_tools import load_config
from igaussian_core.compile_map import training_images
from igaussian_core.evaluate.image_changes import Change
from igaussian_core.evaluate.photos import extent, held_out_images
from igaussian_core.geometry import pose_error
from igaussian_core.localizer import Localizer
from igaussian_core.posed_images import PosedImage, read_posed_images

Image = NDArray[np.uint8]
Array = NDArray[np.float64]

MAPS = CASES[:5]
SETS = ("fox", "flower", "fern", "redkitchen", "lego", "shelf", "desk5")
HARMLESS = {
    "as taken": None, "gain 0.5": Change("gain", 0.5), "gain 2": Change("gain", 2.0),
    "gamma 0.7": Change("gamma", 0.7), "gamma 1.4": Change("gamma", 1.4),
    "JPEG 40": Change("jpeg", 40), "blur 3 px": Change("blur", 3.0),
}  # fmt: skip


@dataclass(frozen=True)
class Case:
    """An image for one map.

    Attributes:
        T_map_cam: where it was taken; None: nowhere in the map.
        prior: handed to the localizer.
    """

    kind: str
    image: Image
    camera: Camera
    T_map_cam: Array | None = None
    prior: Array | None = None


@dataclass(frozen=True)
class Answer:
    """What the localizer said to one case."""

    map: str
    kind: str
    accepted: bool
    right: bool
    inliers: int
    matcher: str
    status: str
    confidence: float
    agreement: float
    sharpness: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path)
    parser.add_argument("--roc", type=Path, help="picture of the ROC")
    parser.add_argument("--work", type=Path)
    parser.add_argument("--photos", type=int, default=8, help="most photos of each set")
    parser.add_argument("--set", action="append", default=[], help="configuration, e.g. a.b=1")
    arguments = parser.parse_args()
    # no time limit, so that other work on the machine changes times and not answers
    config = load_config(None, ["runtime.budget_ms=60000", *arguments.set])
    answers: list[Answer] = []
    with tempfile.TemporaryDirectory() as temporary:
        for name, data_set, with_cameras, kind, prefix in MAPS:
            folder = data_folder() / "sets" / data_set
            package = compiled(
                arguments.work or Path(temporary), name, folder, with_cameras, kind
            )
            localizer = Localizer.open(package, config)
            size = extent(training_images(folder / "map.ply", folder / "poses.json"))
            cases = _cases(localizer, folder, prefix, arguments.photos)
            answers += [_answer(localizer, name, case, size) for case in cases]
            print(f"{name}: {sum(a.map == name for a in answers)} images", flush=True)
    report = {
        "facts": facts(), "images": _by_kind(answers),
        "answers": [asdict(a) for a in answers],
    }  # fmt: skip
    print(verdict(report))
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1))
    if arguments.roc:
        _draw(answers, arguments.roc)


def _cases(localizer: Localizer, folder: Path, prefix: str, count: int) -> Iterator[Case]:
    own = [i for i in held_out_images(folder / "poses.json", None) if i.name.startswith(prefix)]
    own = own[:: max(1, len(own) // count)][:count]
    background = tuple(round(255 * value) for value in localizer.manifest.background)
    poses = [localizer.T_map_scene.camera(photo.T_scene_cam) for photo in own]
    for index, (photo, T_map_cam) in enumerate(zip(own, poses, strict=True)):
        image = photo.read(background)
        for name, change in HARMLESS.items():
            changed = change.apply(image, index) if change else image
            yield Case(name, changed, photo.camera, T_map_cam)
        for name, spoilt in _spoilt(image):
            yield Case(name, spoilt, photo.camera, T_map_cam)
    for index, (photo, image) in enumerate(_other_scenes(folder.name, count)):
        yield Case("other scene", image, photo.camera)
        yield Case(
            "other scene, prior", image, photo.camera, prior=poses[index % len(poses)]
        )
    rng = np.random.default_rng(0)
    camera = own[0].camera
    for name, image in _synthetic(rng, camera.height, camera.width):
        yield Case(name, image, camera)
        yield Case(f"{name}, prior", image, camera, prior=poses[0])


def _other_scenes(own: str, count: int) -> Iterator[tuple[PosedImage, Image]]:
    for name in SETS:
        if name != own:
            photos = read_posed_images(data_folder() / "sets" / name / "poses.json")
            for photo in photos[:: max(1, len(photos) // count)][:count]:
                yield photo, photo.read()


def _spoilt(image: Image) -> Iterator[tuple[str, Image]]:
    """Images that show the scene badly; a pose from them must still be right."""
    height, width = image.shape[:2]
    left, top = image.copy(), image.copy()
    left[:, : width // 2] = 0
    top[: height // 2] = (170, 120, 100)  # a finger
    yield "half covered", left
    yield "half covered", cv2.GaussianBlur(top, (0, 0), 2).astype(np.uint8)
    sigma = max(height, width) / 60
    yield "heavy blur", np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.uint8)
    yield "mirrored", np.ascontiguousarray(image[:, ::-1])


def _synthetic(
    rng: np.random.Generator, height: int, width: int
) -> Iterator[tuple[str, Image]]:
    shape = (height, width, 3)
    yield "black", np.zeros(shape, np.uint8)
    yield "white", np.full(shape, 255, np.uint8)
    yield "noise", rng.integers(0, 256, shape, dtype=np.uint8)
    for cell in (8, 32):
        coarse = rng.integers(0, 256, (height // cell + 1, width // cell + 1, 3), dtype=np.uint8)
        yield "noise", np.asarray(cv2.resize(coarse, (width, height)), np.uint8)


def _answer(localizer: Localizer, map_name: str, case: Case, size: float) -> Answer:
    result = localizer.localize(case.image, case.camera, case.prior)
    right = False
    if result.T_map_cam is not None and case.T_map_cam is not None:
        angle, distance = pose_error(result.T_map_cam, case.T_map_cam)
        right = angle < 5 and distance < 0.05 * size
    return Answer(
        map_name, case.kind, result.ok, right, result.inliers, result.matcher,
        result.status.value, result.confidence, result.agreement, result.sharpness,
    )  # fmt: skip


def _by_kind(answers: list[Answer]) -> dict[str, dict[str, object]]:
    kinds: dict[str, dict[str, object]] = {}
    for kind in dict.fromkeys(a.kind for a in answers):
        some = [a for a in answers if a.kind == kind]
        wrong = [a for a in some if not a.right]
        kinds[kind] = {
            "images": len(some),
            "accepted": sum(a.accepted for a in some),
            "right": sum(a.right for a in some),
            "wrong_accepted": sum(a.accepted for a in wrong),
            "wrong_inliers": max((a.inliers for a in wrong), default=0),
            "wrong_confidence": max((a.confidence for a in wrong), default=0.0),
            "usable": kind in HARMLESS,
        }
    return kinds


def _draw(answers: list[Answer], path: Path) -> None:
    """ROC by the threshold on confidence, the verdict's marked."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    # of what must be accepted, the right ones; and what is not right, whatever it shows
    usable = [a for a in answers if a.kind in HARMLESS]
    right = np.array([a.confidence for a in usable if a.right])
    others = [a for a in answers if a.kind not in HARMLESS and not a.right]
    kinds = dict.fromkeys(a.kind.removesuffix(", prior") for a in others)
    thresholds = np.linspace(0, 1, 1001)
    recall = np.array([(right >= t).sum() / len(usable) for t in thresholds])
    wrong = np.array([a.confidence for a in others])
    false = np.array([(wrong >= t).mean() for t in thresholds])
    at = int(np.searchsorted(thresholds, 0.5))
    figure, (left, axes) = plt.subplots(1, 2, figsize=(11, 4.5))
    left.step(false, recall, where="post")
    left.plot(false[at], recall[at], "o", label="confidence 0.5, the verdict")
    left.set(xlabel="share of the other images not right with as much confidence",
             ylabel="recall", ylim=(-0.02, 1.02))  # fmt: skip
    left.set_title(f"{len(usable)} usable photos, {len(wrong)} others, {len(MAPS)} maps")
    left.legend(loc="lower right")
    bins = np.linspace(0, 1, 41)
    axes.hist(right, bins, alpha=0.6, label="usable photos, right")
    axes.hist(
        [[a.confidence for a in others if a.kind.removesuffix(", prior") == k] for k in kinds],
        bins, stacked=True, alpha=0.8, label=[f"{k}, not right" for k in kinds],
    )  # fmt: skip
    axes.axvline(0.5, color="black", linestyle="--")
    axes.set(xlabel="confidence", ylabel="images", yscale="log")
    axes.legend(fontsize=7, loc="upper right")
    for part in (left, axes):
        part.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=120)


if __name__ == "__main__":
    main()
