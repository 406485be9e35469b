"""`igaussian train scale-vit`: train the paper's learned scale on procedural maps.

    python -m igaussian_core.cli_train_scale -o out/scale_vit
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from igaussian_core.cli_tools import Stages, console
from igaussian_core.errors import IGaussianError


def register(app: typer.Typer) -> None:
    """Add the command to a group."""
    app.command("scale-vit")(train_scale_vit)


def train_scale_vit(
    folder: Annotated[
        Path, typer.Option("-o", "--output", help="folder of the run; it goes on where it was")
    ] = Path("out/scale_vit"),
    maps: Annotated[int, typer.Option(help="procedural maps to train on", min=1)] = 120,
    places: Annotated[int, typer.Option(help="places in each map", min=1)] = 60,
    steps: Annotated[int, typer.Option(help="of the optimiser", min=1)] = 6000,
    batch: Annotated[int, typer.Option(help="pairs a step", min=1)] = 24,
    rate: Annotated[float, typer.Option(help="highest learning rate", min=1e-9)] = 3e-3,
    every: Annotated[int, typer.Option(help="steps between validations", min=1)] = 250,
    seed: Annotated[int, typer.Option(help="of maps, weights and batches", min=0)] = 0,
    minutes: Annotated[
        float | None, typer.Option(help="stop after so many; called again, it goes on", min=0)
    ] = None,
    threads: Annotated[int, typer.Option(help="of the network", min=1)] = 2,
) -> None:
    """Train the scale ViT; its weights, curves and picture are written to the folder."""
    import torch

    from igaussian_core.train_scale import ScaleTraining
    from igaussian_core.train_scale import train_scale_vit as train

    torch.set_num_threads(threads)
    options = ScaleTraining(
        maps=maps, places=places, steps=steps, batch=batch, rate=rate, every=every, seed=seed
    )
    with _bars() as bars:
        errors = train(folder, options, minutes, Stages(bars))
    console.print_json(json.dumps({"weights": str(folder / "scale_vit.safetensors"), **errors}))


def _bars() -> Progress:
    return Progress(
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        TextColumn("left"), TimeRemainingColumn(), console=console,
    )  # fmt: skip


if __name__ == "__main__":
    try:
        typer.run(train_scale_vit)
    except IGaussianError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)
