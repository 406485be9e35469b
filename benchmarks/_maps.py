"""The maps that benchmarks run on, compiled once into a work folder."""

from __future__ import annotations

from pathlib import Path

from _data import data_folder

from igaussian_core.compile_map import CompileOptions, compile_map
from igaussian_core.map_package import MapPackage, NetworkData, open_package, read_tensors
from igaussian_core.training.map_network import add_untrained_network

ROOT = Path(__file__).resolve().parents[1]
DEMO_ROOM = "demo room"
STAGE_ONE = ROOT / "out" / "stage_one"  # where stage_one.py keeps what it trained


def map_sources(name: str) -> tuple[Path, Path]:
    """Gaussians and training cameras of a set of the data folder, or of the demo room."""
    if name == DEMO_ROOM:
        demo = ROOT / "bags" / "demo"
        return demo / "room.ply", demo / "mapping_cameras.json"
    folder = data_folder() / "sets" / name
    return folder / "map.ply", folder / "poses.json"


def compiled_path(work: Path, name: str) -> Path:
    """A map in `work` as `igaussian map compile` makes it; compiled now where it is not yet."""
    target = work / f"{'room' if name == DEMO_ROOM else name}.igmap"
    if not target.is_dir():
        compile_as_users_do(target, *map_sources(name))
    return target


def compile_as_users_do(
    target: Path, source: Path, cameras: Path | None, kind: str | None = None
) -> None:
    """As `igaussian map compile` does, with an untrained network."""
    compile_map(source, target, cameras, CompileOptions(kind=kind))
    add_untrained_network(target)


def compiled(work: Path, name: str) -> MapPackage:
    """The same, opened."""
    return open_package(compiled_path(work, name))


def network_file(name: str, trained_for: str, work: Path = STAGE_ONE) -> Path:
    """Where stage_one.py keeps a network that it trained on a map, for "memory" or "heads"."""
    return work / f"{name.replace(' ', '_')}-{trained_for}.safetensors"


def trained_network(name: str, trained_for: str) -> NetworkData | None:
    """That network; None where it was not trained yet."""
    file = network_file(name, trained_for)
    return read_tensors(file) if file.is_file() else None
