"""What the command line's groups share: options, configuration, progress bars, numbers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from igaussian_core.errors import ConfigError

console = Console()

MapOption = Annotated[Path, typer.Option("--map", help="compiled map directory (.igmap)")]
ConfigOption = Annotated[
    Path | None, typer.Option("--config", help="JSON file of configuration groups")
]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", help="one value, e.g. refine.rounds=2; repeatable")
]


def load_config(file: Path | None, settings: list[str] | None) -> Any:
    """Config of a file and of `group.key=value` settings, which win."""
    from igaussian_core.config import Config

    flat = Config.from_file(file).to_flat() if file else {}
    for setting in settings or []:
        name, separator, text = setting.partition("=")
        if not separator:
            raise ConfigError(f"--set {setting}: expected group.key=value")
        try:
            flat[name] = json.loads(text)
        except ValueError:
            flat[name] = text
    return Config.from_flat(flat)


def progress_bars() -> Progress:
    return Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        TextColumn("left"), TimeRemainingColumn(),
        console=console,
    )  # fmt: skip


class Stages:
    """Shows one progress bar for each stage as it reports itself."""

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._tasks: dict[str, Any] = {}

    def __call__(self, stage: str, done: int, of: int) -> None:
        if stage not in self._tasks:
            self._tasks[stage] = self._progress.add_task(stage, total=of)
        self._progress.update(self._tasks[stage], completed=done, total=of)


def numbers(text: str | None, count: int, name: str) -> tuple[float, ...] | None:
    if text is None:
        return None
    try:
        values = tuple(float(part) for part in text.replace(",", " ").split())
    except ValueError as error:
        raise ConfigError(f"{name} '{text}': expected {count} numbers") from error
    if len(values) != count:
        raise ConfigError(f"{name} '{text}': expected {count} numbers, got {len(values)}")
    if not np.isfinite(values).all():
        raise ConfigError(f"{name} '{text}': expected finite numbers")
    return values


def direction(text: str | None, name: str) -> tuple[float, ...] | None:
    values = numbers(text, 3, name)
    if values is not None and not any(values):
        raise ConfigError(f"{name} '{text}': a direction is not all zero")
    return values
