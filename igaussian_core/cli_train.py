"""The command group `igaussian train`: networks, on views that maps render of themselves."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Annotated, Any

import typer

from igaussian_core.cli_tools import (
    ConfigOption,
    SetOption,
    Stages,
    console,
    load_config,
    progress_bars,
)
from igaussian_core.errors import ConfigError

train_app = typer.Typer(help="Train networks on views that maps render.", no_args_is_help=True)

StepsOption = Annotated[int | None, typer.Option(help="steps of the optimiser", min=0)]
SeedOption = Annotated[int, typer.Option(help="of everything random")]
CurvesOption = Annotated[Path | None, typer.Option(help="picture of the curves")]
BoardOption = Annotated[Path | None, typer.Option(help="folder that TensorBoard reads")]
DeviceOption = Annotated[str, typer.Option(help="of the network: cpu or cuda")]
AttentionOption = Annotated[
    str | None,
    typer.Option(help="of random weights: tokens (default), views, none; paper; plain regression"),
]


@train_app.command("map")
def train_map(
    map_path: Annotated[Path, typer.Argument(help="compiled map directory (.igmap)")],
    steps: StepsOption = None,
    head: Annotated[
        str | None,
        typer.Option(help="what is trained; memory: what the map's views of known pose tell; "
                     "attention: the paper's candidates and weights, and the memory behind them; "
                     "default: memory, or attention where --attention is given"),
    ] = None,
    start: Annotated[
        str | None,
        typer.Option(help="joint: the shipped weights; random; a checkpoint file; default: joint, "
                     "or random where --attention is given"),
    ] = None,
    sources: Annotated[int, typer.Option(help="source views", min=1, max=64)] = 16,
    bank: Annotated[
        int | None, typer.Option(help="rendered views to train on, kept at a time", min=32)
    ] = None,
    memory: Annotated[
        int | None, typer.Option(help="views of known pose kept to predict by; 0: none", min=0)
    ] = None,
    seed: SeedOption = 0,
    curves: CurvesOption = None,
    tensorboard: BoardOption = None,
    attention: AttentionOption = None,
    config: ConfigOption = None,
    set_: SetOption = None,
) -> None:
    """Train the pose network of a compiled map and store it there; no photo is needed.

    An interrupted training goes on where it was when the same command is given again.
    """
    from igaussian_core.map_package import open_package, with_network
    from igaussian_core.training.map_network import train_map_network

    package = open_package(map_path)
    start = start or ("random" if attention else "joint")
    options = _options(_of_head(head, attention, start, memory), seed, steps=steps)
    threads = load_config(config, set_).runtime.threads
    with progress_bars() as progress:
        trained, curve = train_map_network(
            package, _start(start, attention), options, sources=sources, bank=bank,
            memory=memory, threads=threads,
            checkpoint=map_path.with_name(map_path.name + ".training"), progress=Stages(progress),
        )  # fmt: skip
    with_network(map_path, trained.data())
    _write_curve(curve, curves, tensorboard)
    console.print(f"{map_path}: pose network: {network_summary(trained.report)}")


@train_app.command("joint")
def train_joint(
    output: Annotated[Path, typer.Option("-o", "--output", help="checkpoint (.safetensors)")],
    maps: Annotated[int, typer.Option(help="procedural rooms and objects", min=1)] = 140,
    steps: StepsOption = None,
    seed: SeedOption = 0,
    curves: CurvesOption = None,
    tensorboard: BoardOption = None,
    attention: AttentionOption = None,
    threads: Annotated[
        int, typer.Option(help="that render maps; on a CPU of the network too", min=1)
    ] = 2,
    views: Annotated[int | None, typer.Option(help="of an episode", min=8)] = None,
    episodes: Annotated[int | None, typer.Option(help="a step", min=1)] = None,
    rate: Annotated[
        float | None, typer.Option(help="highest learning rate", min=1e-9)
    ] = None,
    device: DeviceOption = "cpu",
) -> None:
    """Train one network on many procedural maps: what `train map` starts from."""
    from igaussian_core.coarse.network import save_checkpoint
    from igaussian_core.training.joint import OPTIONS, train_jointly

    given = {"steps": steps, "views": views, "episodes": episodes, "learning_rate": rate}
    options = _options(OPTIONS, seed, **given)
    with progress_bars() as progress:
        network, curve = train_jointly(
            maps, options, _config(attention), threads,
            output.with_name(output.name + ".training"), Stages(progress), _device(device),
        )  # fmt: skip
    last = {name: values[-1] for name, values in curve.values.items()}
    save_checkpoint(network, output, {"maps": maps, **dataclasses.asdict(options), **last})
    _write_curve(curve, curves, tensorboard)
    console.print(f"{output}: {last}")


@train_app.command("scale-vit")
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
    threads: Annotated[
        int, typer.Option(help="that render views; on a CPU of the network too", min=1)
    ] = 2,
    device: DeviceOption = "cpu",
) -> None:
    """Train the scale ViT; its weights, curves and picture are written to the folder."""
    import torch

    from igaussian_core.training.scale_vit import ScaleTraining
    from igaussian_core.training.scale_vit import train_scale_vit as train

    torch.set_num_threads(threads)
    options = ScaleTraining(
        maps=maps, places=places, steps=steps, batch=batch, rate=rate, every=every, seed=seed
    )
    with progress_bars() as bars:
        errors = train(folder, options, minutes, Stages(bars), threads, _device(device))
    console.print_json(json.dumps({"weights": str(folder / "scale_vit.safetensors"), **errors}))


def network_summary(report: dict[str, Any]) -> str:
    """One line on how good a map's network is."""
    return (
        f"median error {report['median_deg']:.2f} degrees and "
        f"{report['median_distance']:.3g} scene units "
        f"({report['median_distance'] / report['length']:.1%} of {report['length']:.3g}), "
        f"{report['within_15_deg']:.1%} within 15 degrees, on {report['held_out_views']} views "
        "that it was not trained on"
    )


def _of_head(head: str | None, attention: str | None, start: str, memory: int | None) -> Any:
    from igaussian_core.training import map_network

    if head not in (None, "memory", "attention"):
        raise ConfigError(f"--head {head}: neither memory nor attention")
    if head == "memory" and attention is not None:
        raise ConfigError(f"--attention {attention}: of --head attention")
    if head != "attention" and attention is None:
        if memory == 0:
            raise ConfigError("--memory 0: of --head attention; there is nothing else to train for")
        return map_network.FOR_MEMORY
    return map_network.FOR_HEADS if start == "random" else map_network.FOR_HEADS_FROM_WEIGHTS


def _options(options: Any, seed: int, **given: float | None) -> Any:
    """Options with those replaced that were given."""
    kept = {name: value for name, value in given.items() if value is not None}
    return dataclasses.replace(options, seed=seed, **kept)


def _device(name: str) -> str:
    import torch

    if name not in ("cpu", "cuda"):
        raise ConfigError(f"--device {name}: neither cpu nor cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise ConfigError("--device cuda: this installation of torch sees no such GPU")
    return name


def _start(start: str, attention: str | None) -> Any:
    from igaussian_core.coarse.attention import PoseNetwork
    from igaussian_core.coarse.network import load_checkpoint, shipped_checkpoint

    if start == "random":
        return PoseNetwork(_config(attention))
    if attention is not None:
        raise ConfigError(f"--attention {attention}: of --start random; {start} has its own")
    return load_checkpoint(shipped_checkpoint() if start == "joint" else Path(start))


def _config(attention: str | None) -> Any:
    from igaussian_core.coarse.attention import ATTENTIONS, PAPER, PLAIN, NetworkConfig

    if attention is None:
        return NetworkConfig()
    whole = {"paper": PAPER, "plain": PLAIN}
    if attention in whole:
        return whole[attention]
    if attention not in ATTENTIONS:
        known = ", ".join((*ATTENTIONS, *whole))
        raise ConfigError(f"--attention {attention}: none of {known}")
    return NetworkConfig(attention=attention)


def _write_curve(curve: Any, picture: Path | None, tensorboard: Path | None) -> None:
    from igaussian_core.training.curves import plot_curve, write_tensorboard

    if picture is not None:
        plot_curve(curve, picture)
    if tensorboard is not None:
        write_tensorboard(curve, tensorboard)
