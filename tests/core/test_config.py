"""Every option, its range, and the ways to set it wrongly."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from igaussian_core.config import Config, Option, options
from igaussian_core.errors import ConfigError

OPTIONS = options()
EVERY_OPTION = pytest.mark.parametrize(("name", "option"), OPTIONS.items(), ids=OPTIONS)


def wrong_types(option: Option) -> list[Any]:
    wrong: dict[type, list[Any]] = {
        int: [1.5, "3", True, None, [1]],
        float: ["0.5", True, None, [0.5]],
        bool: [1, 0.0, "true", None],
        str: [1, None, True],
    }
    return wrong[option.type]


@EVERY_OPTION
def test_default_is_within_its_own_range(name: str, option: Option) -> None:
    assert type(option.default) is option.type
    assert len(option.help) > 5
    assert Config.from_flat({name: option.default}) == Config()


@EVERY_OPTION
def test_wrong_type_is_refused(name: str, option: Option) -> None:
    for value in wrong_types(option):
        with pytest.raises(ConfigError, match=name):
            Config.from_flat({name: value})


@EVERY_OPTION
def test_range_is_enforced(name: str, option: Option) -> None:
    if option.type in (int, float):
        assert option.low is not None and option.high is not None and option.low < option.high
        for value in (option.low, option.high):  # the ends belong to the range
            assert Config.from_flat({name: option.type(value)}).to_flat()[name] == value
        for value in (option.low - 1, option.high + 1):
            with pytest.raises(ConfigError, match="outside"):
                Config.from_flat({name: option.type(value)})
    elif option.type is str and option.choices:  # without choices: a path
        assert option.default in option.choices
        for choice in option.choices:
            assert Config.from_flat({name: choice}).to_flat()[name] == choice
        with pytest.raises(ConfigError, match="none of"):
            Config.from_flat({name: "nonsense"})


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_not_a_number_is_out_of_range(value: float) -> None:
    with pytest.raises(ConfigError, match="outside"):
        Config.from_flat({"refine.max_reprojection_px": value})


def test_an_integer_serves_as_float() -> None:
    config = Config.from_flat({"refine.max_reprojection_px": 4})
    assert config.refine.max_reprojection_px == 4.0
    assert type(config.refine.max_reprojection_px) is float


def test_only_what_is_named_changes() -> None:
    config = Config.from_flat({"coarse.top_views": 2, "runtime.threads": 1})
    assert config.coarse.top_views == 2 and config.runtime.threads == 1
    changed = {k for k, v in config.to_flat().items() if v != Config().to_flat()[k]}
    assert changed == {"coarse.top_views", "runtime.threads"}


@pytest.mark.parametrize("name", ["coarse.top", "top_views", "coarse", "", "coarse.top_views.x"])
def test_unknown_key_is_refused_with_what_is_known(name: str) -> None:
    with pytest.raises(ConfigError, match="unknown key.*coarse.top_views"):
        Config.from_flat({name: 1})


def test_configuration_is_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        Config().coarse.top_views = 7  # type: ignore[misc]


def test_file_round_trip(tmp_path: Path) -> None:
    config = Config.from_flat(
        {"features.matcher": "sift", "verify.min_spread": 0.25, "tracking.enabled": False}
    )
    file = tmp_path / "config.json"
    file.write_text(config.to_json())
    assert Config.from_file(file) == config
    assert Config.from_flat(config.to_flat()) == config
    assert list(config.to_flat()) == list(OPTIONS)


@pytest.mark.parametrize(
    "text",
    [
        "", "{", "3", "[]", '{"coarse": 3}', '{"coarse": {"speed": 1}}', '{"coarse.top_views": 2}',
        '{"nothing": {"top_views": 1}}', '{"coarse": {"top_views": "2"}}',
        '{"coarse": {"top_views": 99}}',
        "\udcff",
    ],
)  # fmt: skip
def test_bad_files_are_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "config.json"
    file.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(ConfigError):
        Config.from_file(file)


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="absent.json"):
        Config.from_file(tmp_path / "absent.json")


def test_partial_file(tmp_path: Path) -> None:
    file = tmp_path / "config.json"
    file.write_text(json.dumps({"coarse": {"top_views": 1}}))
    assert Config.from_file(file) == Config.from_flat({"coarse.top_views": 1})
