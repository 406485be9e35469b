"""Files of trajectories: written and read again, folders of the TUM kind, refusals."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from igaussian_core.errors import DatasetError
from igaussian_core.geometry import compose, pose_error, rotation_from_vector
from igaussian_core.posed_images import read_posed_images
from igaussian_core.tum import read_tum, read_tum_list, write_tum, write_visual_localization

POSES = [compose(rotation_from_vector([0.1 * i, -0.2, 1.0]), [i, 2 * i, -1.0]) for i in range(4)]


def test_a_trajectory_survives(tmp_path: Path) -> None:
    write_tum(tmp_path / "t.txt", [(1.5 + i, T) for i, T in enumerate(POSES)])
    stamps, poses = zip(*read_tum(tmp_path / "t.txt"), strict=True)
    assert stamps == (1.5, 2.5, 3.5, 4.5)
    np.testing.assert_allclose(poses, POSES, atol=1e-8)


def test_order_of_numbers(tmp_path: Path) -> None:
    T = compose(rotation_from_vector([0, 0, np.pi / 2]), [1, 2, 3])
    write_tum(tmp_path / "t.txt", [(0.25, T)])
    line = (tmp_path / "t.txt").read_text().splitlines()[-1]
    half = np.sqrt(0.5)
    assert [float(v) for v in line.split()] == pytest.approx([0.25, 1, 2, 3, 0, 0, half, half])
    write_visual_localization(tmp_path / "r.txt", [("a.png", T)])
    name, *numbers = (tmp_path / "r.txt").read_text().split()
    # of the inverse: world to camera
    assert name == "a.png"
    assert [float(v) for v in numbers] == pytest.approx([half, 0, 0, -half, -2, 1, -3])


@pytest.mark.parametrize(
    ("text", "cause"),
    [("1 2 3\n", "line 1"), ("# c\n0 0 0 0 0 0 0 0\n", "line 2"), ("a b c d e f g h\n", "line 1")],
)
def test_bad_lines_are_named(tmp_path: Path, text: str, cause: str) -> None:
    (tmp_path / "t.txt").write_text(text)
    with pytest.raises(DatasetError, match=cause):
        read_tum(tmp_path / "t.txt")
    with pytest.raises(DatasetError, match="missing.txt"):
        read_tum(tmp_path / "missing.txt")
    (tmp_path / "l.txt").write_text("1.0 a.png extra\n")
    with pytest.raises(DatasetError, match="line 1"):
        read_tum_list(tmp_path / "l.txt")


def test_a_tum_folder(tmp_path: Path) -> None:
    stamped = [(10.0 + 0.05 * i, T) for i, T in enumerate(POSES)]
    write_tum(tmp_path / "groundtruth.txt", [*stamped, (20.0, POSES[0])])
    # on a pose, between two, before the first, inside a gap
    names = "10.05 rgb/a.png\n10.075 rgb/b.png\n9.0 rgb/c.png\n15.0 rgb/d.png\n"
    (tmp_path / "rgb.txt").write_text("# colour images\n" + names)
    with pytest.raises(DatasetError, match=r"camera\.json"):
        read_posed_images(tmp_path)
    camera = {"width": 64, "height": 48, "fx": 50, "fy": 51, "cx": 31.5, "cy": 23.5}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    first, second = read_posed_images(tmp_path)
    assert (first.name, second.name) == ("rgb/a.png", "rgb/b.png")
    assert first.path == tmp_path / "rgb/a.png" and first.camera.cx == 31.5
    assert pose_error(first.T_scene_cam, POSES[1])[0] < 1e-5
    one, other = (pose_error(second.T_scene_cam, T)[0] for T in POSES[1:3])
    assert one == pytest.approx(other, rel=1e-4) and one > 1
    (tmp_path / "camera.json").write_text('{"width": 3}')
    with pytest.raises(DatasetError):
        read_posed_images(tmp_path)
