"""The compiled map on disk: whole or refused, and an old one survives a failing save."""

from __future__ import annotations

import dataclasses
import json
import logging
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import room
from safetensors.numpy import load_file, save_file

from igaussian_core import map_package
from igaussian_core.errors import MapError
from igaussian_core.gaussian_map import file_sha256, save_ply
from igaussian_core.geometry import Sim3, rotation_from_vector
from igaussian_core.map_package import (
    Landmarks,
    Manifest,
    MapPackage,
    open_package,
    save_package,
    with_T_map_scene,
)

T_MAP_SCENE = Sim3(2.5, rotation_from_vector([0.1, -0.7, 2.0]), np.array([1.0, 2.0, -3.0]))


def some_package(name: str = "tiny") -> MapPackage:
    rng = np.random.default_rng(0)
    descriptors = rng.normal(size=(30, 64)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    landmarks = Landmarks(
        rng.normal(size=(30, 3)).astype(np.float32), descriptors, np.array([0, 10, 30], np.int64),
        np.stack([np.eye(4)] * 2), np.array([[64, 48, 50, 50, 31.5, 23.5]] * 2, float),
    )  # fmt: skip
    manifest = Manifest(
        name, "scene", 0.5, [[0, 0, 0], [3, 2.6, 2]], T_MAP_SCENE.matrix().tolist(), "xfeat",
        [0.0, 0.5, 1.0], f"{name}.ply", "0" * 64, "",
    )  # fmt: skip
    return MapPackage(manifest, room.room(0, per_metre=4), landmarks)


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    save_package(some_package(), tmp_path / "tiny.igmap")
    return tmp_path / "tiny.igmap"


def test_round_trip(saved: Path) -> None:
    package, back = some_package(), open_package(saved)
    expected = dataclasses.replace(
        package.manifest, gaussians_sha256=file_sha256(saved / "gaussians.ply")
    )
    assert back.manifest == expected
    assert back.T_map_scene.scale == pytest.approx(2.5)
    assert np.allclose(back.T_map_scene.matrix(), T_MAP_SCENE.matrix())
    assert np.array_equal(back.landmarks.points, package.landmarks.points)
    assert np.allclose(back.landmarks.descriptors, package.landmarks.descriptors, atol=1e-3)
    assert back.landmarks.descriptors.dtype == np.float32
    assert np.array_equal(back.landmarks.offsets, package.landmarks.offsets)
    assert np.array_equal(back.landmarks.T_scene_cam, package.landmarks.T_scene_cam)
    assert np.array_equal(back.landmarks.intrinsics, package.landmarks.intrinsics)
    assert back.landmarks.view_count == 2
    assert np.allclose(back.gaussians.means, package.gaussians.means)
    assert np.allclose(back.gaussians.opacities, package.gaussians.opacities, atol=1e-6)


def test_only_data_lies_in_a_package(saved: Path) -> None:
    assert sorted(f.name for f in saved.iterdir()) == [
        "gaussians.ply", "landmarks.safetensors", "manifest.json",
    ]  # fmt: skip
    assert saved.stat().st_mode & 0o755 == 0o755


def test_saving_again_replaces_the_whole(saved: Path) -> None:
    (saved / "leftover").write_text("x")
    save_package(some_package("other"), saved)
    assert open_package(saved).manifest.name == "other"
    assert not (saved / "leftover").exists()
    assert [f.name for f in saved.parent.iterdir()] == [saved.name]  # no staging left


def test_a_failing_save_leaves_the_old_one(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full_disk(*args: Any, **kwargs: Any) -> None:
        raise OSError(28, "No space left on device")

    before = open_package(saved).manifest
    monkeypatch.setattr(map_package, "save_file", full_disk)
    with pytest.raises(MapError, match="No space left"):
        save_package(some_package("other"), saved)
    assert open_package(saved).manifest == before
    assert [f.name for f in saved.parent.iterdir()] == [saved.name]


def test_a_failing_first_save_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*args: Any, **kwargs: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(map_package, "save_ply", interrupted)
    with pytest.raises(KeyboardInterrupt):
        save_package(some_package(), tmp_path / "tiny.igmap")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_is_no_map_is_not_overwritten(tmp_path: Path, kind: str) -> None:
    target = tmp_path / "precious"
    if kind == "file":
        target.write_text("data")
    else:
        target.mkdir()
        (target / "thesis.tex").write_text("data")
    with pytest.raises(MapError, match="left alone"):
        save_package(some_package(), target)
    assert "data" in (target if kind == "file" else target / "thesis.tex").read_text()


def test_a_target_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(MapError, match="cannot be written"):
        save_package(some_package(), tmp_path / "file" / "tiny.igmap")


def test_missing_and_uncompiled(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="no such directory.*map compile"):
        open_package(tmp_path / "absent.igmap")
    with pytest.raises(MapError, match="no compiled map"):
        open_package(tmp_path)
    save_ply(room.room(0, per_metre=4), tmp_path / "scene.ply")
    with pytest.raises(MapError, match="compile"):
        open_package(tmp_path / "scene.ply")


def edit(folder: Path, **change: Any) -> None:
    file = folder / "manifest.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **change}))


def test_a_newer_version_is_refused(saved: Path) -> None:
    edit(saved, version=map_package.VERSION + 1)
    with pytest.raises(MapError, match=f"version {map_package.VERSION + 1}.*update"):
        open_package(saved)


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "3", "null", '{"format": "zip"}', "\x00",
     '{"format": "igaussian-map", "version": 1}'],
)  # fmt: skip
def test_a_damaged_manifest_is_refused(saved: Path, text: str) -> None:
    (saved / "manifest.json").write_text(text)
    with pytest.raises(MapError, match="manifest"):
        open_package(saved)


@pytest.mark.parametrize(
    "change",
    [{"T_map_scene": [[1, 0], [0, 1]]}, {"T_map_scene": None}, {"T_map_scene": "x"},
     {"T_map_scene": np.zeros((4, 4)).tolist()}, {"surplus": 1}, {"background": 3},
     {"background": [0, 0]}, {"background": [0, 0, "x"]}, {"source_file": 5}, {"kind": 3}],
    ids=repr,
)  # fmt: skip
def test_values_without_sense_are_refused(saved: Path, change: dict[str, Any]) -> None:
    edit(saved, **change)
    with pytest.raises(MapError, match="manifest"):
        open_package(saved)


def test_altered_gaussians_are_refused(saved: Path) -> None:
    data = bytearray((saved / "gaussians.ply").read_bytes())
    data[-3] ^= 1
    (saved / "gaussians.ply").write_bytes(bytes(data))
    with pytest.raises(MapError, match="was changed"):
        open_package(saved)


@pytest.mark.parametrize("name", ["gaussians.ply", "landmarks.safetensors", "manifest.json"])
def test_a_missing_part_is_named(saved: Path, name: str) -> None:
    (saved / name).unlink()
    with pytest.raises(MapError, match=name):
        open_package(saved)


@pytest.mark.parametrize("length", [0, 4, 100, -1])
def test_cut_landmarks_are_refused(saved: Path, length: int) -> None:
    file = saved / "landmarks.safetensors"
    file.write_bytes(file.read_bytes()[:length])
    with pytest.raises(MapError, match="landmarks"):
        open_package(saved)


@pytest.mark.parametrize("change", ["offsets", "fewer points", "no views", "missing key"])
def test_landmarks_that_do_not_belong_together(saved: Path, change: str) -> None:
    file = saved / "landmarks.safetensors"
    data = load_file(str(file))
    if change == "offsets":
        data["offsets"] = np.array([0, 10, 31], np.int64)
    elif change == "fewer points":
        data["points"] = data["points"][:-1]
    elif change == "no views":
        data["T_scene_cam"] = data["T_scene_cam"][:1]
    else:
        del data["descriptors"]
    save_file(data, str(file))
    with pytest.raises(MapError, match="landmarks"):
        open_package(saved)


def test_a_changed_source_is_only_warned_of(saved: Path, caplog: pytest.LogCaptureFixture) -> None:
    (saved.parent / "tiny.ply").write_text("another file")
    with caplog.at_level(logging.WARNING):
        open_package(saved)
    assert "tiny.ply was changed" in caplog.text


def test_T_map_scene_can_be_changed_alone(saved: Path) -> None:
    parts = {name: file_sha256(saved / name) for name in ("gaussians.ply", "landmarks.safetensors")}
    T = Sim3(0.1, rotation_from_vector([0, 0, 1]), np.array([4.0, 5, 6]))
    manifest = with_T_map_scene(saved, T)
    assert open_package(saved).manifest == manifest
    assert np.allclose(open_package(saved).T_map_scene.matrix(), T.matrix())
    assert parts == {name: file_sha256(saved / name) for name in parts}
    with pytest.raises(MapError):
        with_T_map_scene(saved.parent / "absent", T)


@pytest.mark.parametrize(
    "T",
    [Sim3(np.nan, np.eye(3), np.zeros(3)), Sim3(1.0, np.full((3, 3), np.nan), np.zeros(3)),
     Sim3(1.0, np.eye(3), np.array([np.inf, 0, 0])), Sim3(0.0, np.eye(3), np.zeros(3))],
)  # fmt: skip
def test_a_useless_T_map_scene_does_not_spoil_the_map(saved: Path, T: Sim3) -> None:
    before = open_package(saved).manifest
    with pytest.raises(MapError, match="similarity"):
        with_T_map_scene(saved, T)
    assert open_package(saved).manifest == before


def test_a_map_may_be_moved(saved: Path, tmp_path: Path) -> None:
    shutil.move(saved, tmp_path / "elsewhere.igmap")
    assert open_package(tmp_path / "elsewhere.igmap").manifest.name == "tiny"


def test_others_may_read_a_map(room_igmap: Path) -> None:
    """It may be compiled by one user and used by the node of another."""
    assert all(file.stat().st_mode & 0o044 == 0o044 for file in room_igmap.iterdir())
