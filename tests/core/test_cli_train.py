"""igaussian train, map compile --train, map views, eval --stage-one."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import pytest
from typer.testing import CliRunner

from igaussian_core.cli import app
from igaussian_core.coarse.network import MapNetwork, load_checkpoint
from igaussian_core.config import Config
from igaussian_core.errors import ConfigError, MapError
from igaussian_core.localizer import Localizer
from igaussian_core.map_package import open_package


def run(*arguments: object) -> str:
    """Output of a command that succeeds, in one line; its error is raised."""
    result = CliRunner().invoke(app, [str(a) for a in arguments], env={"COLUMNS": "200"})
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    assert result.exit_code == 0, result.output
    return " ".join(result.output.split())


@pytest.fixture(autouse=True)
def few_views(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, few in (("MEMORY", 96), ("UNTRAINED_MEMORY", 160), ("UNTRAINED_HELD_OUT", 8)):
        monkeypatch.setattr(f"igaussian_core.training.map_network.{name}", few)


@pytest.fixture
def copied(room_igmap: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(room_igmap, tmp_path / "room.igmap"))


def test_a_map_is_trained_from_the_command_line(copied: Path, tmp_path: Path) -> None:
    before = run("map", "info", copied)
    output = run(
        "train", "map", copied, "--steps", 2, "--bank", 64, "--sources", 4,
        "--curves", tmp_path / "curves.png", "--tensorboard", tmp_path / "board",
    )  # fmt: skip
    assert "that it was not trained on" in output and "degrees" in output
    assert cv2.imread(str(tmp_path / "curves.png")) is not None
    assert any((tmp_path / "board").iterdir())
    assert not copied.with_name("room.igmap.training").exists()
    assert "pose network" not in before
    assert "pose network" in run("map", "info", copied)
    size = sum(file.stat().st_size for file in copied.iterdir())
    assert size < 60e6

    run("eval", "rendered", "--map", copied, "--targets", 1, "--stage-one",
        "--json", tmp_path / "stage_one.json", "--set", "coarse.method=network")  # fmt: skip
    document = json.loads((tmp_path / "stage_one.json").read_text())
    assert document["summary"]["queries"] == 3 and document["summary"]["accepted"] == 3
    assert document["facts"]["stage"].startswith("one alone")


def test_the_same_where_the_map_is_compiled(room_ply: Path, tmp_path: Path) -> None:
    target = tmp_path / "fresh.igmap"
    run("map", "compile", room_ply, "-o", target, "--cameras", room_ply.with_name("poses.json"),
        "--views", 12, "--train", "--train-steps", 1)  # fmt: skip
    assert open_package(target).network is not None


def test_a_compiled_map_has_an_untrained_network(room_ply: Path, tmp_path: Path) -> None:
    target = tmp_path / "fresh.igmap"
    command = ("map", "compile", room_ply, "-o", target, "--cameras",
               room_ply.with_name("poses.json"), "--views", 12)  # fmt: skip
    assert "pose network, untrained: median error" in run(*command)
    data = open_package(target).network
    assert data is not None
    trained = MapNetwork.from_data(data, "fresh")
    assert trained.report["options"]["steps"] == 0 and trained.report["memory"] == 160
    run(*command, "--no-network")
    assert open_package(target).network is None


def test_a_map_that_shows_too_little_is_compiled_without(
    room_ply: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise MapError("the map shows too little")

    monkeypatch.setattr("igaussian_core.training.map_network.training_map", fails)
    output = run("map", "compile", room_ply, "-o", tmp_path / "room.igmap", "--cameras",
                 room_ply.with_name("poses.json"), "--views", 12)  # fmt: skip
    assert "no pose network, landmarks alone: the map shows too little" in output
    assert open_package(tmp_path / "room.igmap").network is None


@pytest.mark.parametrize(
    ("device", "said"), [("tpu", "--device tpu: neither cpu nor cuda"), ("cuda", "sees no such")]
)
def test_a_device_that_is_not_there_is_named(
    tmp_path: Path, device: str, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(ConfigError, match=said):
        run("train", "joint", "-o", tmp_path / "joint.safetensors", "--device", device)


def test_joint_training_writes_a_checkpoint(tmp_path: Path) -> None:
    run("train", "joint", "-o", tmp_path / "joint.safetensors", "--maps", 2, "--steps", 1)
    assert load_checkpoint(tmp_path / "joint.safetensors").config.attention == "tokens"


def test_a_checkpoint_that_is_none(copied: Path, tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"none\.safetensors"):
        run("train", "map", copied, "--start", tmp_path / "none.safetensors")
    assert open_package(copied).network is None


def test_the_layout_of_the_cameras_as_a_picture(copied: Path, tmp_path: Path) -> None:
    output = run("map", "views", copied, "--plot", tmp_path / "views.png", "--count", 8)
    picture = cv2.imread(str(tmp_path / "views.png"))
    assert picture is not None and picture.shape[0] > 500 and picture.std() > 5
    assert "R = " in output


def test_heads_that_are_not_trained_are_not_asked(copied: Path) -> None:
    ask = Config.from_flat({"coarse.network_head": "attention"})
    few = ("--steps", 1, "--bank", 32, "--sources", 2)
    run("train", "map", copied, *few)
    with pytest.raises(MapError, match=r"no trained heads.*--head attention"):
        Localizer.open(copied, ask)
    run("train", "map", copied, *few, "--head", "attention")
    assert Localizer.open(copied, ask) is not None


@pytest.mark.parametrize("attention", ["paper", "plain", "views"])
def test_other_networks_can_be_trained(copied: Path, attention: str) -> None:
    run("train", "map", copied, "--steps", 1, "--bank", 32, "--sources", 2, "--attention",
        attention)  # fmt: skip
    assert open_package(copied).network is not None


def test_an_unknown_network_is_named(copied: Path) -> None:
    with pytest.raises(ConfigError, match="--attention more: none of tokens"):
        run("train", "map", copied, "--attention", "more")
    with pytest.raises(ConfigError, match="--attention plain: of --start random; joint has"):
        run("train", "map", copied, "--attention", "plain", "--start", "joint")
    with pytest.raises(ConfigError, match="--attention plain: of --head attention"):
        run("train", "map", copied, "--attention", "plain", "--head", "memory")
    with pytest.raises(ConfigError, match="--memory 0: of --head attention"):
        run("train", "map", copied, "--memory", 0)
    with pytest.raises(ConfigError, match="--head both: neither"):
        run("train", "map", copied, "--head", "both")
