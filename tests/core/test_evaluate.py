"""The runner, the rendered track, changes of images, files and the report."""

from __future__ import annotations

import csv
import dataclasses
import functools
import inspect
import json
import math
import re
from pathlib import Path

import numpy as np
import pytest
import room
from typer.testing import CliRunner

from igaussian_core.bags import Bag
from igaussian_core.camera import Camera
from igaussian_core.cli_eval import eval_app
from igaussian_core.config import Config
from igaussian_core.errors import ConfigError
from igaussian_core.evaluate.drive import Trajectory
from igaussian_core.evaluate.drive_run import run_drive
from igaussian_core.evaluate.image_changes import changed, changed_colours, parse_change
from igaussian_core.evaluate.metrics import QueryOutcome
from igaussian_core.evaluate.photos import PhotoQueries
from igaussian_core.evaluate.rendered import (
    BINS_DEG,
    RenderedQueries,
    camera_of,
    shows_enough,
    targets,
)
from igaussian_core.evaluate.report import Evaluation, write_csv, write_html, write_json
from igaussian_core.evaluate.runner import Estimator, Partial, Queries, run
from igaussian_core.evaluate.trajectory_errors import trajectory_errors
from igaussian_core.gaussian_map import GaussianMap
from igaussian_core.geometry import Sim3, pose_error
from igaussian_core.localizer import Localizer
from igaussian_core.map_package import open_package
from igaussian_core.result import LocalizationResult, Status
from igaussian_core.sphere import Sphere, sphere_of
from igaussian_core.tum import read_tum
from igaussian_core.views import look_at

OBJECT, SCENE = Sphere("object", 4.0, (0.1, 0.2, 0.3)), Sphere("scene", 0.1)


def direction_angle(a: np.ndarray, b: np.ndarray) -> float:
    return math.degrees(math.acos(np.clip(a[:3, 2] @ b[:3, 2], -1, 1)))


@pytest.mark.parametrize("sphere", [OBJECT, SCENE], ids=lambda s: s.kind)
def test_targets_lie_in_their_bins(sphere: Sphere) -> None:
    drawn = targets(sphere, each=40, translation=0.2)
    assert len(drawn) == 120 and len({t.name for t in drawn}) == 120
    for low, high in BINS_DEG:
        part = [t for t in drawn if t.bin == f"{low:g}-{high:g}"]
        assert len(part) == 40
        for t in part:
            assert low - 1e-6 <= direction_angle(t.T_scene_cam, t.T_scene_source) <= high + 1e-6
            offset = t.T_scene_cam[:3, 3].copy()
            if sphere.kind == "object":
                # seen from the centre at distance R, before the offset
                offset -= np.array(sphere.centre) - sphere.radius * t.T_scene_cam[:3, 2]
            else:
                offset -= t.T_scene_source[:3, 3]
            assert np.abs(offset).max() <= 0.2 + 1e-9 and np.abs(offset).max() > 0
            assert abs(t.T_scene_cam[2, 0]) < 1e-9  # upright: the image's x axis is level


def test_pure_rotation_keeps_the_position() -> None:
    for t in targets(SCENE, each=5, translation=0.0):
        np.testing.assert_allclose(t.T_scene_cam[:3, 3], t.T_scene_source[:3, 3], atol=1e-12)


def test_targets_repeat_with_their_seed() -> None:
    first, again, other = (targets(SCENE, 3, seed=s) for s in (1, 1, 2))
    np.testing.assert_array_equal(first[5].T_scene_cam, again[5].T_scene_cam)
    assert not np.allclose(first[5].T_scene_cam, other[5].T_scene_cam)


def test_views_of_nothing_are_drawn_again_or_refused(room_map: GaussianMap) -> None:
    def ahead(T: np.ndarray) -> bool:
        return bool(T[0, 2] > 0.5)

    assert all(ahead(t.T_scene_cam) for t in targets(SCENE, 5, usable=ahead))
    with pytest.raises(ConfigError, match="20-40"):
        targets(SCENE, 1, usable=lambda T: False)
    covered = shows_enough(room_map, room.CAMERA)
    assert covered(room.query_poses(1)[0])
    away = np.eye(4)
    away[:3, 3] = 50
    assert not covered(away)


@pytest.fixture
def queries(room_igmap: Path) -> RenderedQueries:
    package = open_package(room_igmap)
    drawn = targets(sphere_of(package), each=2, translation=0.1, seed=4)
    changes = (parse_change("paper"),)
    camera = camera_of(package)
    return RenderedQueries(
        tuple(drawn), package.gaussians, camera, (0, 0, 0), package.T_map_scene, changes
    )


def test_the_rendered_track(queries: RenderedQueries, localizer: Localizer) -> None:
    done = run(lambda: localizer, queries)
    assert [o.group for o in done.outcomes] == ["20-40"] * 2 + ["40-80"] * 2 + ["80-180"] * 2
    good = [o for o in done.outcomes if o.angle_deg < 0.3 and o.distance < 0.02]
    assert len(good) >= 5
    assert done.memory_mb > 100


def test_the_map_may_lie_elsewhere(queries: RenderedQueries) -> None:
    """Truth and source prior are in the map's frame, with its scale."""
    shift = Sim3(2.0, np.eye(3), np.array([1.0, 0, 0]))
    moved = RenderedQueries(
        queries.targets, queries.gmap, queries.camera, (0, 0, 0), shift, with_source_prior=True
    )
    T = queries.targets[0].T_scene_cam
    np.testing.assert_allclose(moved.truth(0)[:3, 3], 2 * T[:3, 3] + [1, 0, 0])
    prior = moved.prior(0)
    assert prior is not None and 20 <= pose_error(prior, moved.truth(0))[0] <= 41
    assert queries.prior(0) is None


# --- the runner ---


class Fixed:
    """Says the same pose of every image and remembers what it was given."""

    def __init__(self) -> None:
        self.calls: list[tuple[object, ...]] = []

    def localize(
        self, image: np.ndarray, camera: Camera, prior: object = None
    ) -> LocalizationResult:
        self.calls.append((image, camera, prior))
        return LocalizationResult(Status.OK, "", np.eye(4), np.eye(6), timings_ms={"total": 1.0})


class Blank:
    """Four black images."""

    def __init__(self, count: int = 4) -> None:
        self.count = count

    def __len__(self) -> int:
        return self.count

    def name(self, index: int) -> str:
        return f"q{index}"

    def group(self, index: int) -> str:
        return ""

    def image(self, index: int) -> tuple[np.ndarray, Camera]:
        return np.zeros((8, 8, 3), np.uint8), Camera(8, 8, 8, 8, 3.5, 3.5)

    def prior(self, index: int) -> None:
        return None

    def truth(self, index: int) -> np.ndarray:
        T = np.eye(4)
        T[0, 3] = index
        return T


def test_an_estimator_gets_image_camera_and_prior_only() -> None:
    assert list(inspect.signature(Estimator.localize).parameters) == [
        "self", "image", "camera", "prior",
    ]  # fmt: skip
    fixed = Fixed()
    outcomes = run(lambda: fixed, Blank()).outcomes
    assert [o.distance for o in outcomes] == [0, 1, 2, 3]
    for image, camera, prior in fixed.calls:
        assert isinstance(image, np.ndarray) and isinstance(camera, Camera) and prior is None


def test_truth_is_asked_for_after_the_answer() -> None:
    order: list[str] = []

    class Watched(Blank):
        def truth(self, index: int) -> np.ndarray:
            order.append("truth")
            return super().truth(index)

    class Slow(Fixed):
        def localize(self, *arguments: object) -> LocalizationResult:  # type: ignore[override]
            order.append("answer")
            return super().localize(*arguments)  # type: ignore[arg-type]

    run(Slow, Watched(2))
    assert order == ["answer", "truth", "answer", "truth"]


def test_an_interrupted_run_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "part.jsonl"
    first = run(Fixed, Blank(2), Partial(path, "run a")).outcomes
    with open(path, "a") as stream:
        stream.write('{"name": "q2", "cut of')
    fixed = Fixed()
    steps: list[tuple[int, int]] = []
    done = run(lambda: fixed, Blank(), Partial(path, "run a"), progress=lambda *s: steps.append(s))
    assert len(fixed.calls) == 2 and steps[0] == (2, 4)
    assert [o.name for o in done.outcomes] == ["q0", "q1", "q2", "q3"]
    assert done.outcomes[1].distance == first[1].distance == 1
    assert len(Partial(path, "run a").outcomes()) == 4
    assert Partial(path, "run b").outcomes() == {}  # another run: begun anew
    assert len(path.read_text().splitlines()) == 1
    Partial(path, "run b").remove()
    assert not path.exists()


def test_processes_agree_with_one(queries: RenderedQueries, room_igmap: Path) -> None:
    two = RenderedQueries(
        queries.targets[:2], queries.gmap, queries.camera, (0, 0, 0), queries.T_map_scene
    )
    two.image(0)  # packs the map, which must not travel
    opener = functools.partial(Localizer.open, room_igmap)
    alone, parallel = (run(opener, two, jobs=jobs).outcomes for jobs in (1, 2))
    assert [o.name for o in parallel] == [o.name for o in alone]
    for a, b in zip(alone, parallel, strict=True):
        assert a.distance == pytest.approx(b.distance, abs=1e-3)


# --- changes of images ---

GRADIENT = np.tile(np.arange(0, 256, 4, dtype=np.uint8)[None, :, None], (48, 1, 3))


def test_changes_do_what_they_say() -> None:
    def after(text: str) -> np.ndarray:
        return changed(GRADIENT, (parse_change(text),), seed=0).astype(float)

    assert after("gain=0.5")[0, 40, 0] == 80 and after("gain=2")[0, -1, 0] == 255
    assert after("gamma=1.4")[0, 32, 1] == pytest.approx(255 * (128 / 255) ** 1.4, abs=1)
    assert after("gamma=1.4")[0, 0, 0] == 0
    assert np.abs(after("jpeg=40") - GRADIENT).max() > 0
    assert np.abs(after("jpeg=40") - GRADIENT).mean() < 4
    assert after("blur=3")[:, :1].min() > 0 and after("blur=0").tolist() == GRADIENT.tolist()
    assert 4 < (after("noise=5")[:, 20:40] - GRADIENT[:, 20:40]).std() < 6
    both = changed(GRADIENT, (parse_change("gain=0.5"), parse_change("gain=2")), 0)
    assert np.abs(both.astype(int) - GRADIENT).max() <= 1


def test_the_papers_colours_depend_on_the_seed() -> None:
    a, again, b = (changed_colours(GRADIENT, s) for s in (1, 1, 2))
    assert a.dtype == np.uint8 and a.shape == GRADIENT.shape
    assert (a == again).all() and (a != b).any()


@pytest.mark.parametrize("text", ["", "paper=1", "gain", "gain=x", "gain=0", "shear=1", "jpeg=101"])
def test_a_useless_change_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="--change"):
        parse_change(text)


# --- files and report ---


@pytest.fixture
def evaluation(queries: RenderedQueries, localizer: Localizer) -> Evaluation:
    done = run(lambda: localizer, queries)
    lost = QueryOutcome("lost <1>", "inconsistent", "why", "", 3, 0.1, math.inf, math.inf, 2.0, 0.1,
                        math.nan, {"total": 5.0}, "80-180")  # fmt: skip
    outcomes = [*done.outcomes, lost]
    return Evaluation("A <map>", "rendered", outcomes, 5.0, 0.05, 300.0, Config(), {"map": "<m>"})


def test_json_and_csv(evaluation: Evaluation, tmp_path: Path) -> None:
    write_json(evaluation, tmp_path / "new" / "out.json")
    text = (tmp_path / "new" / "out.json").read_text()
    data = json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))
    assert data["track"] == "rendered" and len(data["queries"]) == 7
    assert data["summary"]["queries"] == 7 and list(data["groups"]) == ["20-40", "40-80", "80-180"]
    assert data["queries"][-1]["angle_deg"] is None
    assert data["stage_times"]["total"]["median_ms"] > 0
    write_csv(evaluation, tmp_path / "out.csv")
    rows = list(csv.DictReader((tmp_path / "out.csv").open()))
    assert len(rows) == 7 and rows[-1]["tx"] == "" and rows[-1]["nees"] == ""
    T = evaluation.outcomes[0].T_map_cam
    assert T is not None
    assert [float(rows[0][k]) for k in ("tx", "ty", "tz")] == pytest.approx(T[:3, 3].tolist())
    with pytest.raises(ConfigError, match="cannot be written"):
        write_csv(evaluation, tmp_path / "missing" / "out.csv")


@pytest.mark.parametrize("limit", [0.05, math.inf])
def test_the_report_needs_no_other_file(
    evaluation: Evaluation, queries: RenderedQueries, localizer: Localizer, tmp_path: Path,
    limit: float,
) -> None:  # fmt: skip
    class WithLost(RenderedQueries):
        def __len__(self) -> int:
            return len(self.targets) + 1

        def name(self, index: int) -> str:
            return "lost <1>" if index == 6 else super().name(index)

        def image(self, index: int) -> tuple[np.ndarray, Camera]:
            return super().image(min(index, 5))

    every = WithLost(**{k: v for k, v in queries.__dict__.items()})
    limited = dataclasses.replace(evaluation, max_distance=limit)
    write_html(limited, every, localizer, tmp_path / "report.html")
    text = (tmp_path / "report.html").read_text()
    assert "A &lt;map&gt;" in text and "lost &lt;1&gt;: inconsistent, why" in text
    assert "<script" not in text
    links = re.findall(r"(?:src|href)='([^']*)", text)
    assert len(links) >= 4 + 4 * 3 + 1  # plots, worst cases, one without a pose
    assert all(link.startswith("data:image/") for link in links)
    for heading in ("By group", "Recall", "Time by stage", "Worst accepted", "Rejected"):
        assert f"<h2>{heading}" in text


def test_queries_fit_the_protocol(queries: RenderedQueries) -> None:
    sets: list[Queries] = [queries, PhotoQueries((), Sim3.identity())]
    assert [len(s) for s in sets] == [6, 0]


# --- trajectories ---


def circle(count: int = 20) -> list[np.ndarray]:
    return [look_at([np.cos(a), np.sin(a), 1.0], [0, 0, 1.0]) for a in np.linspace(0, 3, count)]


def stamped(estimated: list[np.ndarray], true: list[np.ndarray]) -> list:  # type: ignore[type-arg]
    return [(e, t, 100 + 0.1 * i) for i, (e, t) in enumerate(zip(estimated, true, strict=True))]


def test_ate_of_a_shifted_trajectory() -> None:
    """A constant shift is an absolute error, but none after alignment and none of motion."""
    true = circle()
    moved = [T.copy() for T in true]
    for T in moved:
        T[:3, 3] += [0.03, 0.0, 0.04]
    errors = trajectory_errors(stamped(moved, true))
    assert [errors["ate_rmse_m"], errors["ate_max_m"]] == pytest.approx([0.05, 0.05])
    assert errors["ate_aligned_rmse_m"] < 1e-9
    assert errors["rpe_rmse_m"] < 1e-9 and errors["rpe_rmse_deg"] < 1e-3


def test_a_mirrored_trajectory_is_wrong() -> None:
    true = circle()
    mirrored = [T.copy() for T in true]
    for T in mirrored:
        T[1, 3] *= -1
    assert trajectory_errors(stamped(mirrored, true))["ate_rmse_m"] > 1
    assert math.isnan(trajectory_errors(stamped(true[:2], true[:2]))["ate_rmse_m"])


def test_rpe_of_a_jump() -> None:
    true = circle(11)
    jumped = [T.copy() for T in true]
    for T in jumped[5:]:
        T[2, 3] += 0.1
    # one of ten motions is wrong by 0.1
    assert trajectory_errors(stamped(jumped, true))["rpe_rmse_m"] == pytest.approx(
        0.1 / math.sqrt(10)
    )


def test_a_recording_is_judged(repo_root: Path, localizer: Localizer) -> None:
    """The bundled drive in a map of another room: frames are processed, none is accepted."""
    path = repo_root / "bags" / "demo" / "drive"
    with Bag(path) as bag:
        truth = Trajectory(bag.poses(None))
        run = run_drive(bag, localizer, Config(), truth, duration_s=0.4, every_frame=True)
    assert 3 <= len(run.frames) <= 6 and run.dropped == 0
    assert all(f.T_map_cam is None and f.T_map_cam_true is not None for f in run.frames)
    assert all(m.rss_mb > 100 for m in run.memory)


def test_the_command_writes_everything(room_igmap: Path, tmp_path: Path) -> None:
    def evaluate(*words: object) -> str:
        arguments = ["rendered", "--map", room_igmap, "--targets", 1, "--translation", 0.1, *words]
        answer = CliRunner().invoke(eval_app, [str(word) for word in arguments])
        assert answer.exit_code == 0, answer.output
        return answer.output

    files = {name: tmp_path / name for name in ("json", "csv", "report", "tum", "results")}
    options = [word for name, path in files.items() for word in (f"--{name}", path)]
    assert "success" in evaluate(*options, "--change", "gain=0.8")
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(files)  # no partial file is left
    data = json.loads(files["json"].read_text())
    assert data["facts"]["changes"] == "paper, gain=0.8"
    assert len(read_tum(files["tum"])) == data["summary"]["accepted"] >= 2
    assert len(files["results"].read_text().splitlines()) == data["summary"]["accepted"]
    turned = evaluate("--rotation-only", "--exact-colours", "--json", files["json"])
    assert "wherever" in turned
    data = json.loads(files["json"].read_text())
    assert data["thresholds"]["distance"] is None and data["facts"]["changes"] == "none"
