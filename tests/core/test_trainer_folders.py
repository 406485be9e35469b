"""Folders as INRIA's trainer and nerfstudio's splatfacto leave them."""

from __future__ import annotations

import json
from collections import OrderedDict
from pathlib import Path

import numpy as np
import pytest
import torch

from igaussian_core.errors import MapError
from igaussian_core.formats import map_file
from igaussian_core.gaussian_map import GaussianMap, load_map, save_ply
from igaussian_core.geometry import compose, rotation_from_vector
from igaussian_core.posed_images import read_posed_images


def test_inria_folder(tmp_path: Path, room_map: GaussianMap) -> None:
    """The newest iteration by number: 7000 is older than 30000, though later in the alphabet."""
    for iteration, count in ((7000, 20), (30000, 30)):
        folder = tmp_path / "point_cloud" / f"iteration_{iteration}"
        folder.mkdir(parents=True)
        save_ply(room_map.subset(np.arange(count)), folder / "point_cloud.ply")
    assert map_file(tmp_path).parent.name == "iteration_30000"
    assert len(load_map(tmp_path)) == 30


def checkpoint(gmap: GaussianMap) -> dict[str, object]:
    logit = np.log(gmap.opacities / (1 - gmap.opacities))
    arrays = {
        "means": gmap.means, "quats": gmap.quats_wxyz, "scales": np.log(gmap.scales),
        "opacities": logit[:, None], "features_dc": gmap.sh[:, 0], "features_rest": gmap.sh[:, 1:],
    }  # fmt: skip
    state = OrderedDict(
        (f"_model.gauss_params.{k}", torch.from_numpy(np.ascontiguousarray(v)))
        for k, v in arrays.items()
    )
    return {"step": 100, "pipeline": state, "optimizers": {}}


def test_splatfacto_folder(tmp_path: Path, room_map: GaussianMap) -> None:
    part = room_map.subset(np.arange(50))
    folder = tmp_path / "nerfstudio_models"
    folder.mkdir()
    torch.save(checkpoint(room_map.subset(np.arange(9))), folder / "step-000002000.ckpt")
    torch.save(checkpoint(part), folder / "step-000029999.ckpt")
    loaded = load_map(tmp_path)
    assert loaded.file_format == "nerfstudio checkpoint"
    np.testing.assert_allclose(loaded.means, part.means)
    np.testing.assert_allclose(loaded.scales, part.scales, rtol=1e-5)
    np.testing.assert_allclose(loaded.opacities, part.opacities, rtol=1e-5)
    np.testing.assert_allclose(loaded.sh, part.sh)


class Evil:
    def __reduce__(self) -> tuple[object, ...]:
        return (Path.touch, (Path("ran"),))


def test_bad_checkpoints_are_refused(
    tmp_path: Path, room_map: GaussianMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "step-000000001.ckpt"
    torch.save({"pipeline": Evil()}, file)
    with pytest.raises(MapError, match="plain data"):
        load_map(file)
    assert not (tmp_path / "ran").exists()
    torch.save({"pipeline": {"_model.means": torch.zeros(3, 3)}}, file)
    with pytest.raises(MapError, match="lacks quats"):
        load_map(file)
    data = checkpoint(room_map.subset(np.arange(9)))
    data["pipeline"]["_model.gauss_params.scales"] = torch.zeros(3, 3)  # type: ignore[index]
    torch.save(data, file)
    with pytest.raises(MapError, match="different lengths"):
        load_map(file)
    file.write_bytes(file.read_bytes()[:200])
    with pytest.raises(MapError):
        load_map(file)
    with pytest.raises(MapError, match="a folder without a map"):
        load_map(tmp_path)


def test_poses_in_nerfstudios_frame(tmp_path: Path) -> None:
    """By nerfstudio's rule: position * scale after transform, relative to the applied one."""
    pose = compose(rotation_from_vector([0.1, 0.2, 0.3]), [1.0, 2.0, 3.0])
    data = {
        "w": 8, "h": 8, "fl_x": 9, "applied_transform": [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]],
        "frames": [{"file_path": "a.png", "transform_matrix": pose.tolist()}],
    }  # fmt: skip
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    (plain,) = read_posed_images(tmp_path / "transforms.json")
    np.testing.assert_allclose(plain.T_scene_cam[:3, 3], [1, 2, 3])
    auto = compose(rotation_from_vector([0, 0, 1.0]), [0.5, 0, 0])
    applied = np.vstack([data["applied_transform"], [0, 0, 0, 1]])
    saved = {"transform": (auto @ applied)[:3].tolist(), "scale": 0.25}
    (tmp_path / "dataparser_transforms.json").write_text(json.dumps(saved))
    (moved,) = read_posed_images(tmp_path / "transforms.json")
    np.testing.assert_allclose(moved.T_scene_cam[:3, 3], 0.25 * (auto @ pose)[:3, 3])
    np.testing.assert_allclose(
        moved.T_scene_cam[:3, :3], auto[:3, :3] @ plain.T_scene_cam[:3, :3], atol=1e-12
    )
