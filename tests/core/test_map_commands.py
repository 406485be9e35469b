"""igaussian map info, convert and prune, igaussian render, and what stands behind them."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import room as rooms
import splat_files as files
from typer.testing import CliRunner

from igaussian_core.camera import Camera
from igaussian_core.cli import app
from igaussian_core.errors import ConfigError, IGaussianError, ImageError, MapError
from igaussian_core.gaussian_map import GaussianMap, load_map, save_map, save_ply
from igaussian_core.geometry import inverse
from igaussian_core.overview import kind_of, likely_up, orbit, overview, view_target
from igaussian_core.pictures import colour_depth, depth_scale, depth_steps
from igaussian_core.pruning import importance, measure, prune, pruned
from igaussian_core.view_planning import SourceView
from igaussian_core.views import fibonacci_directions, look_at


def run(*arguments: object) -> str:
    """Output of a command that succeeds; its error is raised."""
    result = CliRunner().invoke(app, [str(a) for a in arguments], env={"COLUMNS": "200"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return result.output


def ball(count: int = 3000, seed: int = 0) -> GaussianMap:
    """A coloured ball of flat Gaussians on a level disc, z up: an object."""
    rng = np.random.default_rng(seed)
    normals = fibonacci_directions(count)
    disc = rng.uniform(-1.4, 1.4, (count // 2, 2))
    means = np.concatenate([normals, np.c_[disc, np.full(len(disc), -1.0)]])
    normals = np.concatenate([normals, np.tile([0.0, 0.0, 1.0], (len(disc), 1))])
    # the rotation that takes z to the normal, by half-way vectors
    half = normals + [0, 0, 1 + 1e-6]
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    quats = np.c_[half[:, 2], np.cross([0.0, 0.0, 1.0], half)]
    total = len(means)
    return GaussianMap(
        means.astype(np.float32),
        (quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        np.tile(np.float32([0.05, 0.05, 0.005]), (total, 1)),
        np.full(total, 0.95, np.float32),
        rng.uniform(-1, 1, (total, 1, 3)).astype(np.float32),
    )


@pytest.fixture(scope="module")
def ball_ply(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("ball") / "ball.ply"
    save_ply(ball(), file)
    return file


def test_info_of_a_file(ball_ply: Path) -> None:
    rows = json.loads(run("map", "info", ball_ply, "--json"))
    assert rows["format"] == ".ply"
    assert rows["Gaussians"] == "4,500"
    assert rows["SH degree"] == "0"
    assert rows["left out on loading"].startswith("0 (0.00%")
    assert rows["kind, from the Gaussians"] == "object"
    assert rows["up axis"].startswith("z (likely")
    assert rows["largest scale p1, p50, p99"] == "0.05, 0.05, 0.05"
    assert rows["size on disk"] == f"{ball_ply.stat().st_size / 1e6:.1f} MB"
    table = run("map", "info", ball_ply)
    for key in rows:
        assert key in table


def test_info_counts_what_was_left_out(tmp_path: Path) -> None:
    gmap = files.soft_map(count=40, degree=0)
    files.write_splat(gmap, tmp_path / "map.splat")
    data = bytearray((tmp_path / "map.splat").read_bytes())
    data[:4] = np.float32(np.inf).tobytes()
    (tmp_path / "map.splat").write_bytes(data)
    rows = json.loads(run("map", "info", tmp_path / "map.splat", "--json"))
    assert rows["left out on loading"].startswith("1 (2.50%")
    assert rows["format"] == ".splat"


def test_info_of_an_empty_map(tmp_path: Path) -> None:
    save_ply(ball().subset(np.zeros(4500, bool)), tmp_path / "empty.ply")
    assert json.loads(run("map", "info", tmp_path / "empty.ply", "--json"))["Gaussians"] == "0"


def test_info_of_compiled_maps_and_sog_folders(room_igmap: Path, tmp_path: Path) -> None:
    rows = json.loads(run("map", "info", room_igmap, "--json"))
    assert rows["compiled from"] == "room.ply"
    assert "up axis" in rows
    for name, data in files.sog_files(files.soft_map(count=60)).items():
        (tmp_path / name).write_bytes(data)
    assert json.loads(run("map", "info", tmp_path, "--json"))["format"] == ".sog version 2"


def turned(gmap: GaussianMap, up: str) -> GaussianMap:
    """A map with z up, turned."""
    matrix = {"z": np.eye(3), "-y": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
              "y": [[1, 0, 0], [0, 0, 1], [0, -1, 0]]}[up]  # fmt: skip
    half = np.sqrt(0.5)
    w, x = {"z": (1, 0), "-y": (half, half), "y": (half, -half)}[up]
    q = gmap.quats_wxyz.astype(float)
    quats = np.c_[w * q[:, 0] - x * q[:, 1], w * q[:, 1] + x * q[:, 0],
                  w * q[:, 2] - x * q[:, 3], w * q[:, 3] + x * q[:, 2]]  # fmt: skip
    means = (gmap.means @ np.transpose(matrix)).astype(np.float32)
    return GaussianMap(means, quats.astype(np.float32), gmap.scales, gmap.opacities, gmap.sh)


@pytest.mark.parametrize("turn", ["z", "-y"])
def test_up_axis_of_a_closed_room(turn: str) -> None:
    demo = load_map(Path(__file__).parents[2] / "bags" / "demo" / "room.ply")
    up = likely_up(turned(demo, turn), "scene")
    assert (up.label, up.confidence) == (turn, "likely")


@pytest.mark.parametrize("turn", ["z", "-y", "y"])
def test_up_axis_of_an_object(turn: str) -> None:
    other = turned(ball(), turn)
    up = likely_up(other, "object")
    assert (up.label, up.confidence) == (turn, "likely")


def test_up_axis_that_the_file_names(tmp_path: Path) -> None:
    gmap = ball()
    gmap.vertical_axis = "y"
    save_map(gmap, tmp_path / "map.ply")
    up = likely_up(load_map(tmp_path / "map.ply"), "object")
    assert (up.label, up.confidence) == ("y", "stated")


def test_render_finds_its_own_view(ball_ply: Path, tmp_path: Path) -> None:
    run("render", ball_ply, "-o", tmp_path / "a.png", "--size", "200x150",
        "--depth", tmp_path / "d.png", "--depth-colour", tmp_path / "c.png")  # fmt: skip
    picture = cv2.imread(str(tmp_path / "a.png"))
    assert picture.shape == (150, 200, 3)
    assert (picture[0, 0] == 255).all()  # white behind an object
    assert (picture < 250).any(axis=2).mean() > 0.15  # which fills a good part of the picture
    depth = cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED)
    assert depth.dtype == np.uint16
    view = overview(load_map(ball_ply), 200, 150)
    assert depth[75, 100] / 1000 == pytest.approx(
        np.linalg.norm(view.T_scene_cam[:3, 3] - view.target), abs=1.1
    )
    colours = cv2.imread(str(tmp_path / "c.png"))
    assert (colours[0, 0] == 0).all() and colours[75, 100].any()


def test_render_at_a_given_camera(room_ply: Path, room_map: GaussianMap, tmp_path: Path) -> None:
    cameras = room_ply.with_name("poses.json")
    run("render", room_ply, "-o", tmp_path / "a.png", "--camera", cameras, "--index", 3)
    picture = cv2.imread(str(tmp_path / "a.png"))[..., ::-1] / 255
    expected, _, _ = room_map.render(rooms.CAMERA, inverse(rooms.source_poses()[3]))
    assert picture.shape == expected.shape
    assert np.abs(picture - np.clip(expected, 0, 1)).mean() < 0.01
    with pytest.raises(ConfigError, match="--index 10000"):
        run("render", room_ply, "-o", tmp_path / "b.png", "--camera", cameras, "--index", 10000)


def test_render_of_a_compiled_map(room_igmap: Path, tmp_path: Path) -> None:
    run("render", room_igmap, "-o", tmp_path / "a.png", "--size", "160x120")
    assert cv2.imread(str(tmp_path / "a.png")).std() > 5


def test_orbit_into_a_folder_and_videos(ball_ply: Path, tmp_path: Path) -> None:
    run("render", ball_ply, "-o", tmp_path / "turn", "--orbit", 4, "--size", "80x60")
    pictures = [cv2.imread(str(tmp_path / "turn" / f"{i:03d}.png")) for i in range(4)]
    run("render", ball_ply, "-o", tmp_path / "still.png", "--size", "80x60")
    still = cv2.imread(str(tmp_path / "still.png"))
    assert np.abs(pictures[0].astype(float) - still).mean() < 1  # it starts at the view itself
    assert np.abs(pictures[2].astype(float) - still).mean() > 3
    assert not (tmp_path / "turn" / "004.png").exists()
    for name in ("turn.mp4", "turn.gif")[: 1 + cv2.haveImageWriter("turn.gif")]:
        run("render", ball_ply, "-o", tmp_path / name, "--orbit", 4, "--size", "81x61")
        video = cv2.VideoCapture(str(tmp_path / name))
        frames = [video.read()[1] for _ in range(4)]
        assert all(frame is not None for frame in frames), name
        assert abs(frames[0].shape[1] - 81) <= 1
        assert np.abs(frames[0].astype(float) - frames[2]).mean() > 3


@pytest.mark.parametrize(
    ("arguments", "cause"),
    [
        (["-o", "no folder/a.png"], "cannot be written"),
        (["-o", "a.xyz"], "cannot be written"),
        (["-o", "a.avi", "--orbit", "3"], "supported: .mp4"),
        (["-o", "no folder/a.mp4", "--orbit", "3"], "no such folder"),
        (["-o", "a.png", "--size", "wide"], "--size"),
        (["-o", "a.png", "--background", "1,2"], "--background"),
    ],
)
def test_render_refuses(
    ball_ply: Path, arguments: list[str], cause: str, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    with pytest.raises((ConfigError, ImageError), match=re.escape(cause)):
        run("render", ball_ply, *arguments)


def test_errors_are_one_line(tmp_path: Path, no_ros_path: dict[str, str]) -> None:
    (tmp_path / "bad.spz").write_bytes(b"NGSP")
    result = subprocess.run(
        [sys.executable, "-m", "igaussian_core.cli", "map", "info", str(tmp_path / "bad.spz")],
        env=no_ros_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert result.returncode == 1
    assert result.stderr.strip() == f"error: {tmp_path / 'bad.spz'}: truncated .spz: 4 bytes"


def test_an_empty_map_has_nothing_to_render(tmp_path: Path) -> None:
    save_ply(ball().subset(np.zeros(4500, bool)), tmp_path / "empty.ply")
    with pytest.raises(MapError, match="no Gaussian"):
        run("render", tmp_path / "empty.ply", "-o", tmp_path / "a.png")


def test_depth_steps_reach_as_far_as_the_scene() -> None:
    for far, scale in ((0.5, 1000), (60, 1000), (70, 100), (5000, 10)):
        depth = np.linspace(0, far, 5000, dtype=np.float32).reshape(50, 100)
        assert depth_scale(depth) == scale
        steps = depth_steps(depth, scale)
        assert np.abs(steps / scale - depth).max() <= 0.5 / scale + far * 1e-6
    assert depth_scale(np.zeros((2, 2), np.float32)) == 1000


def test_near_is_red_and_far_is_blue() -> None:
    depth = np.tile(np.linspace(1, 9, 90, dtype=np.float32), (10, 1))
    alpha = np.ones_like(depth)
    alpha[:5] = 0
    colours = colour_depth(depth, alpha).astype(int)
    assert (colours[:5] == 0).all()
    assert colours[7, 0, 0] > colours[7, 0, 2] and colours[7, -1, 2] > colours[7, -1, 0]
    assert not colour_depth(depth, np.zeros_like(alpha)).any()


def test_scene_views_look_at_something(room_map: GaussianMap) -> None:
    view = overview(room_map, 160, 120, kind="scene")
    _, depth, alpha = room_map.render(view.camera, inverse(view.T_scene_cam))
    assert (alpha > 0.5).mean() > 0.8
    centre = depth[alpha > 0.5]
    target = view_target(room_map, view.camera, view.T_scene_cam)
    distance = np.linalg.norm(target - view.T_scene_cam[:3, 3])
    assert centre.min() < distance < centre.max()


def test_orbits() -> None:
    start = look_at((4, 0, 1), (0, 0, 0.5))
    up = np.array([0.0, 0.0, 1.0])
    target = np.array([0.0, 0.0, 0.5])
    around = orbit("object", start, target, up, 8)
    assert np.allclose(around[0], start, atol=1e-9)
    assert np.allclose(around[:, 2, 3], 1)
    assert np.allclose(np.linalg.norm(around[:, :2, 3], axis=1), 4)
    assert np.allclose(around[4, :2, 3], (-4, 0), atol=1e-9)
    nearby = orbit("scene", start, target, up, 8)
    assert np.linalg.norm(nearby[:, :3, 3] - start[:3, 3], axis=1).max() < 0.6
    for T in (*around, *nearby):
        ahead = inverse(T)[:3, :3] @ target + inverse(T)[:3, 3]
        assert ahead[2] > 3 and np.allclose(ahead[:2], 0, atol=1e-9)


def test_kind_of_a_ball() -> None:
    assert kind_of(ball()) == "object"


def test_convert(ball_ply: Path, tmp_path: Path) -> None:
    output = run("map", "convert", ball_ply, "-o", tmp_path / "ball.spz")
    assert "4,500 Gaussians" in output
    assert np.allclose(load_map(tmp_path / "ball.spz").means, load_map(ball_ply).means, atol=1e-5)
    with pytest.raises(IGaussianError, match="cannot write this format"):
        run("map", "convert", ball_ply, "-o", tmp_path / "ball.sog")


def views_around(count: int = 12) -> list[SourceView]:
    camera = Camera(160, 120, 130, 130, 79.5, 59.5)
    return [SourceView(camera, look_at(3.5 * d, (0, 0, 0)))
            for d in fibonacci_directions(count, -0.4, 0.9)]  # fmt: skip


def with_ghosts(gmap: GaussianMap) -> GaussianMap:
    """The map with as many faint or hidden Gaussians as it has others, mixed in."""
    rng = np.random.default_rng(4)
    count = len(gmap)
    opacities = np.full(count, 0.02, np.float32)
    opacities[: count // 2] = 0.5  # these are inside the ball, where nobody sees them
    ghosts = GaussianMap(
        rng.uniform(-0.4, 0.4, (count, 3)).astype(np.float32), gmap.quats_wxyz,
        np.full((count, 3), 0.02, np.float32), opacities, gmap.sh,
    )  # fmt: skip
    both = [np.concatenate([getattr(gmap, n), getattr(ghosts, n)])
            for n in ("means", "quats_wxyz", "scales", "opacities", "sh")]  # fmt: skip
    return GaussianMap(*both)


def test_pruning_leaves_out_what_nobody_sees() -> None:
    gmap = ball()
    mixed = with_ghosts(gmap)
    weights = importance(mixed, views_around())
    assert weights[:4500].mean() > 3 * weights[4500:].mean()
    result = prune(mixed, views_around(), keep=4500)
    assert len(result.gmap) == 4500
    assert result.psnr.mean() > 30
    assert len(result.psnr) == 3
    random = np.random.default_rng(0).random(len(mixed))
    assert measure(pruned(mixed, 4500, random), mixed, views_around()).mean() < 25


def test_pruning_keeps_the_order_and_the_extremes() -> None:
    gmap = ball()
    weights = np.arange(len(gmap), dtype=float)
    assert np.array_equal(pruned(gmap, 10, weights).means, gmap.means[-10:])
    whole = pruned(gmap, 10**9, weights)
    assert np.array_equal(whole.means, gmap.means)
    assert (measure(whole, gmap, views_around(2)) == pytest.approx(99, abs=0.1))
    with pytest.raises(MapError, match="no map"):
        pruned(gmap, 0, weights)


def test_pruning_to_a_time() -> None:
    gmap = ball()
    assert len(prune(gmap, views_around(4), max_milliseconds=1e6).gmap) == len(gmap)
    with pytest.raises(MapError, match="budget"):
        prune(gmap, views_around(4), max_milliseconds=1e-6)
    with pytest.raises(MapError, match="give the count"):
        prune(gmap, views_around(4))
    with pytest.raises(MapError, match="4 views"):
        prune(gmap, views_around(3), keep=5)


def test_prune_command(room_ply: Path, tmp_path: Path) -> None:
    cameras = room_ply.with_name("poses.json")
    out = run("map", "prune", room_ply, "-o", tmp_path / "small.spz", "--keep", "60%",
              "--cameras", cameras, "--views", 8, "--size", 160)  # fmt: skip
    total = len(load_map(room_ply))
    kept = len(load_map(tmp_path / "small.spz"))
    assert kept == round(0.6 * total)
    assert re.search(rf"{kept:,} of {total:,} Gaussians.*PSNR \d+\.\d dB", out.replace("\n", " "))
    with pytest.raises(ConfigError, match="--keep half"):
        run("map", "prune", room_ply, "-o", tmp_path / "b.ply", "--keep", "half")
