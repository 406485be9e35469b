"""The command line: what users type, exit codes, and errors of one line."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import room

from igaussian_core import __version__, cli
from igaussian_core.config import Config
from igaussian_core.errors import ConfigError
from igaussian_core.gaussian_map import GaussianMap
from igaussian_core.geometry import (
    compose,
    pose_error,
    quaternion_from_rotation,
    rotation_from_vector,
)
from igaussian_core.map_package import open_package
from igaussian_core.posed_images import read_image

QUERY = room.query_poses(1, seed=8)[0]


class Ran:
    """Exit code and output of one call."""

    def __init__(self, code: int, out: str, err: str) -> None:
        self.code, self.out, self.err = code, out, err


class Command:
    """Calls `igaussian ...` inside this process, through its entry point."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self._monkeypatch, self._capsys = monkeypatch, capsys

    def __call__(self, *arguments: object) -> Ran:
        self._monkeypatch.setattr(sys, "argv", ["igaussian", *map(str, arguments)])
        self._capsys.readouterr()
        with pytest.raises(SystemExit) as caught:
            cli.main()
            raise SystemExit(0)
        captured = self._capsys.readouterr()
        code = caught.value.code
        return Ran(code if isinstance(code, int) else int(bool(code)), captured.out, captured.err)

    def refused(self, *arguments: object) -> str:
        """The one line of a known error."""
        ran = self(*arguments)
        assert ran.code == 1, ran.out + ran.err
        assert ran.err.startswith("error: ") and ran.err.count("\n") == 1
        assert "Traceback" not in ran.err
        return ran.err


@pytest.fixture
def igaussian(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    # wide enough that no table wraps a word
    monkeypatch.setattr(cli, "console", cli.Console(width=240))
    return Command(monkeypatch, capsys)


@pytest.fixture(scope="module")
def photo(room_map: GaussianMap, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A photo of the room as a file."""
    file = tmp_path_factory.mktemp("photos") / "photo.png"
    cv2.imwrite(str(file), room.photo(room_map, QUERY)[..., ::-1])
    return file


@pytest.fixture
def igmap(room_igmap: Path, tmp_path: Path) -> Path:
    """A copy that a test may change."""
    return Path(shutil.copytree(room_igmap, tmp_path / "copy.igmap"))


def flat_prior(T: np.ndarray) -> str:
    return ",".join(repr(float(v)) for v in [*T[:3, 3], *quaternion_from_rotation(T[:3, :3])])


def test_version_as_a_program(no_ros_path: dict[str, str]) -> None:
    run = subprocess.run(
        [sys.executable, "-m", "igaussian_core.cli", "--version"],
        env=no_ros_path, capture_output=True, text=True,
    )  # fmt: skip
    assert run.returncode == 0 and run.stdout == f"igaussian {__version__}\n"


def test_an_error_as_a_program(no_ros_path: dict[str, str], tmp_path: Path) -> None:
    run = subprocess.run(
        [sys.executable, "-m", "igaussian_core.cli", "map", "info", str(tmp_path / "absent.ply")],
        env=no_ros_path, capture_output=True, text=True,
    )  # fmt: skip
    assert run.returncode == 1 and run.stdout == ""
    assert run.stderr.count("\n") == 1 and "absent.ply" in run.stderr


@pytest.mark.parametrize(
    "words", [[], ["map"], ["map", "compile"], ["map", "align"], ["render"], ["localize"], ["eval"]]
)
def test_help(igaussian: Command, words: list[str]) -> None:
    ran = igaussian(*words, "--help")
    assert ran.code == 0 and "Usage: " in ran.out


def test_an_unknown_command_is_a_usage_error(igaussian: Command) -> None:
    ran = igaussian("fly")
    assert ran.code == 2 and "fly" in ran.err


def test_compile_and_info(igaussian: Command, room_ply: Path, tmp_path: Path) -> None:
    target = tmp_path / "new.igmap"
    ran = igaussian(
        "map", "compile", room_ply, "-o", target, "--cameras", room_ply.with_name("poses.json"),
        "--views", 6, "--kind", "scene", "--radius", 0.25, "--set", "features.keypoints=256",
        "--no-network",
    )  # fmt: skip
    assert ran.code == 0
    assert "landmarks" in ran.out and "source views" in ran.out
    assert open_package(target).network is None
    package = open_package(target)
    assert package.manifest.kind == "scene" and package.manifest.radius == 0.25
    assert 6 <= package.landmarks.view_count <= 6 + 16
    info = igaussian("map", "info", target)
    assert info.code == 0
    for word in ("room.ply", "scene", f"{len(package.gaussians):,}", "xfeat", "SH degree"):
        assert word in info.out


def test_info_of_a_file(igaussian: Command, room_ply: Path, room_map: GaussianMap) -> None:
    ran = igaussian("map", "info", room_ply)
    assert ran.code == 0
    assert f"{len(room_map):,}" in ran.out and "bounds" in ran.out


def test_compile_refuses(igaussian: Command, room_ply: Path, tmp_path: Path) -> None:
    target = tmp_path / "new.igmap"
    assert "absent.ply" in igaussian.refused(
        "map", "compile", tmp_path / "absent.ply", "-o", target
    )
    assert "none of object, scene" in igaussian.refused(
        "map", "compile", room_ply, "-o", target, "--kind", "cave"
    )
    assert "absent.json" in igaussian.refused(
        "map", "compile", room_ply, "-o", target, "--cameras", tmp_path / "absent.json"
    )
    for up in ("0,0", "a,b,c", "0,0,0", "nan,0,1"):
        assert "--up" in igaussian.refused("map", "compile", room_ply, "-o", target, "--up", up)
    for radius in ("-1", "0", "nan"):
        assert "radius" in igaussian.refused(
            "map", "compile", room_ply, "-o", target, "--radius", radius
        )
    (tmp_path / "note.txt").write_text("mine")
    assert "left alone" in igaussian.refused(
        "map", "compile", room_ply, "-o", tmp_path / "note.txt", "--views", 2,
        "--cameras", room_ply.with_name("poses.json"),
    )  # fmt: skip
    assert not target.exists()


def test_align_by_scale_up_and_origin(igaussian: Command, igmap: Path) -> None:
    ran = igaussian("map", "align", igmap, "--scale", 2.5, "--up", "0,-1,0", "--origin", "1,2,3")
    assert ran.code == 0
    T = open_package(igmap).T_map_scene
    assert T.scale == pytest.approx(2.5)
    assert np.allclose(T.points([[1, 2, 3]]), 0, atol=1e-9)  # the origin
    assert np.allclose(T.points([[1, 1, 3]]), [[0, 0, 2.5]], atol=1e-9)  # one unit up is 2.5 m
    assert "2.5" in igaussian("map", "info", igmap).out


def test_align_by_matrix(igaussian: Command, igmap: Path, tmp_path: Path) -> None:
    M = compose(3 * rotation_from_vector([0.1, 0.2, 0.3]), [4, 5, 6])
    file = tmp_path / "T.json"
    file.write_text(json.dumps(M.tolist()))
    assert igaussian("map", "align", igmap, "--matrix", file).code == 0
    assert np.allclose(open_package(igmap).T_map_scene.matrix(), M)


@pytest.mark.parametrize(
    "said",
    [["--scale", "0"], ["--scale", "-1"], ["--scale", "nan"], ["--up", "0,0,0"], ["--up", "1,2"],
     ["--up", "nan,0,1"], ["--origin", "x,y,z"], ["--origin", "inf,0,0"]],
    ids=" ".join,
)  # fmt: skip
def test_a_bad_alignment_leaves_the_map_usable(
    igaussian: Command, igmap: Path, said: list[str]
) -> None:
    before = open_package(igmap).manifest
    igaussian.refused("map", "align", igmap, *said)
    assert open_package(igmap).manifest == before


@pytest.mark.parametrize("text", ["", "{}", "3", "[[1]]", '"x"', "[[1,0,0,0]]", "null"])
def test_a_bad_matrix_is_refused(
    igaussian: Command, igmap: Path, tmp_path: Path, text: str
) -> None:
    file = tmp_path / "T.json"
    file.write_text(text)
    assert "T.json" in igaussian.refused("map", "align", igmap, "--matrix", file)
    assert "none.json" in igaussian.refused(
        "map", "align", igmap, "--matrix", tmp_path / "none.json"
    )


def test_render(igaussian: Command, room_ply: Path, room_map: GaussianMap, tmp_path: Path) -> None:
    cameras, T = room_ply.with_name("poses.json"), room.source_poses()[4]
    ran = igaussian(
        "render", room_ply, "-o", tmp_path / "view.png", "--camera", cameras, "--index", 4,
        "--depth", tmp_path / "depth.png", "--background", "0,0,0",
    )  # fmt: skip
    assert ran.code == 0
    rgb, depth, _ = room_map.render(room.CAMERA, np.linalg.inv(T))
    view = read_image(tmp_path / "view.png")
    assert np.abs(view - np.clip(255 * rgb, 0, 255)).max() < 3  # and not blue for red
    z = cv2.imread(str(tmp_path / "depth.png"), cv2.IMREAD_UNCHANGED)
    assert z.dtype == np.uint16 and np.abs(z / 1000 - depth).max() < 0.01


def test_render_of_a_compiled_map(igaussian: Command, room_igmap: Path, tmp_path: Path) -> None:
    cameras = room_igmap.with_name("poses.json")
    assert igaussian("render", room_igmap, "-o", tmp_path / "v.jpg", "--camera", cameras).code == 0
    assert read_image(tmp_path / "v.jpg").shape == (240, 320, 3)


def test_render_refuses(igaussian: Command, room_ply: Path, tmp_path: Path) -> None:
    cameras = room_ply.with_name("poses.json")
    common = ["render", room_ply, "--camera", cameras]
    for index in (18, -1):
        assert "18 cameras" in igaussian.refused(
            *common, "-o", tmp_path / "v.png", f"--index={index}"
        )
    assert "v.xyz" in igaussian.refused(*common, "-o", tmp_path / "v.xyz")
    assert "absent" in igaussian.refused(*common, "-o", tmp_path / "absent" / "v.png")


def localize(igaussian: Command, photo: Path, igmap: Path, *more: object) -> Ran:
    return igaussian("localize", photo, "--map", igmap, "--fx", room.CAMERA.fx, *more)


def test_localize_as_json(igaussian: Command, photo: Path, room_igmap: Path) -> None:
    ran = localize(igaussian, photo, room_igmap, "--json")
    assert ran.code == 0
    result = json.loads(ran.out)
    angle, distance = pose_error(result["T_map_cam"], QUERY)
    assert angle < 0.15 and distance < 0.004
    assert result["ok"] is True and result["status"] in ("ok", "ok_degraded")
    assert np.array(result["covariance"]).shape == (6, 6)
    assert result["source"] == "landmarks" and result["timings_ms"]["total"] > 0
    assert np.array(result["T_map_cam_coarse"]).shape == (4, 4)


def test_localize_for_people(igaussian: Command, photo: Path, room_igmap: Path) -> None:
    ran = localize(igaussian, photo, room_igmap)
    assert ran.code == 0
    numbers = ran.out.split("position x y z")[1].split("]")[0].split("[")[1]
    assert np.allclose([float(v) for v in numbers.split(",")], QUERY[:3, 3], atol=0.005)


def test_localize_with_a_prior_and_settings(
    igaussian: Command, photo: Path, room_igmap: Path, tmp_path: Path
) -> None:
    (tmp_path / "config.json").write_text(Config().to_json())
    ran = localize(
        igaussian, photo, room_igmap, "--json", "--prior", flat_prior(QUERY), "--fy", 260,
        "--cx", 159.5, "--cy", 119.5, "--config", tmp_path / "config.json",
        "--set", "runtime.threads=1",
    )  # fmt: skip
    assert ran.code == 0 and json.loads(ran.out)["source"] == "prior"


def test_lost_is_exit_code_three_and_valid_json(
    igaussian: Command, room_igmap: Path, tmp_path: Path
) -> None:
    cv2.imwrite(str(tmp_path / "black.png"), np.zeros((240, 320, 3), np.uint8))
    ran = localize(igaussian, tmp_path / "black.png", room_igmap, "--json")
    assert ran.code == 3
    result = json.loads(ran.out, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))
    assert result["ok"] is False and result["T_map_cam"] is None
    assert result["status"] == "too_dark_or_blurred" and result["residual_px"] is None
    people = localize(igaussian, tmp_path / "black.png", room_igmap)
    assert people.code == 3 and "too_dark_or_blurred" in people.out


@pytest.mark.parametrize(
    ("said", "word"),
    [
        (["--prior", "1,2,3"], "--prior"),
        (["--prior", "1,2,3,a,b,c,d"], "--prior"),
        (["--prior", "1,2,3,0,0,0,0"], "prior"),
        (["--prior", "1,nan,3,1,0,0,0"], "prior"),
        (["--dist", "a,b"], "--dist"),
        (["--dist", "0.1"], "coefficients"),
        (["--model", "barrel"], "barrel"),
        (["--fy=-1"], "focal"),
        (["--set", "coarse.speed=1"], "coarse.speed"),
        (["--set", "coarse.top_views"], "group.key=value"),
        (["--set", "coarse.top_views=many"], "coarse.top_views"),
        (["--config", "absent.json"], "absent.json"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_localize_refuses(
    igaussian: Command, photo: Path, room_igmap: Path, said: list[str], word: str
) -> None:
    ran_error = igaussian.refused(
        "localize", photo, "--map", room_igmap, "--fx", room.CAMERA.fx, *said
    )
    assert word in ran_error


def test_localize_refuses_missing_files(
    igaussian: Command, photo: Path, room_igmap: Path, room_ply: Path, tmp_path: Path
) -> None:
    assert "absent.jpg" in igaussian.refused(
        "localize", tmp_path / "absent.jpg", "--map", room_igmap, "--fx", 260
    )
    assert "map compile" in igaussian.refused("localize", photo, "--map", room_ply, "--fx", 260)
    assert localize(igaussian, photo, tmp_path / "absent.igmap").code == 1


def test_eval_photos(
    igaussian: Command, room_map: GaussianMap, room_igmap: Path, tmp_path: Path
) -> None:
    poses = room.query_poses(3, seed=9)
    file = room.write_poses(tmp_path / "poses.json", poses)
    for i, T in enumerate(poses):
        cv2.imwrite(str(tmp_path / f"{i}.png"), room.photo(room_map, T)[..., ::-1])
    arguments = ["eval", "photos", file, "--map", room_igmap, "--max-extent", 0.2]
    assert "would flatter" in igaussian.refused(*arguments)
    (tmp_path / "map.json").write_text(json.dumps({"trained_on": ["0.png"]}))
    out = tmp_path / "out.json"
    assert igaussian(*arguments, "--json", out).code == 0
    data = json.loads(out.read_text())
    assert [query["name"] for query in data["queries"]] == ["1.png", "2.png"]  # held out only
    assert data["summary"]["queries"] == 2 and data["summary"]["accepted"] == 2
    assert data["summary"]["max_deg"] < 0.15
    assert data["config"]["coarse"]["top_views"] == Config().coarse.top_views


def test_settings_win_over_the_file(tmp_path: Path) -> None:
    file = tmp_path / "c.json"
    file.write_text('{"coarse": {"top_views": 1, "hypotheses": 2}}')
    config = cli.load_config(file, ["coarse.top_views=4", "features.matcher=sift"])
    assert (config.coarse.top_views, config.coarse.hypotheses) == (4, 2)
    assert config.features.matcher == "sift"
    with pytest.raises(ConfigError):
        cli.load_config(None, ["=3"])
