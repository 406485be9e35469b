"""The core knows no ROS, its imports go downwards only, and truth cannot reach an estimator."""

from __future__ import annotations

import ast
import inspect
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import igaussian_core
from igaussian_core import errors
from igaussian_core.coarse.landmarks import LandmarkLocalizer
from igaussian_core.localizer import Localizer
from igaussian_core.query import Query
from igaussian_core.refine.refiner import Refiner

CORE = Path(igaussian_core.__file__).parent

# bottom first; a module may import its own layer and those below it
LAYERS = [
    ["errors"],
    ["config", "geometry", "camera", "camera_info", "image_decode", "timing", "result",
     "hypothesis", "frame", "resources", "worker", "contrast", "tum", "torch_cpu"],
    ["render", "posed_images", "bag_storage", "bags", "formats", "colour",
     "pictures"],
    ["gaussian_map"],
    ["views", "lifting", "pnp", "features", "query", "map_package", "camera_traces"],
    ["overview", "sphere"],
    ["view_planning", "map_summary"],
    ["pruning", "procedural"],
    ["coarse", "refine"],
    ["rivals"],
    ["localizer"],
    ["tracker", "replay", "training", "compile_map", "evaluate"],
    ["calibrate"],
    ["cli_tools"],
    ["cli_eval", "cli_train"],
    ["cli"],
]  # fmt: skip
LAYER_OF = {name: level for level, names in enumerate(LAYERS) for name in names}
IMPORT_EVERYTHING = """
import importlib, pkgutil, sys
import igaussian_core
names = [m.name for m in pkgutil.walk_packages(igaussian_core.__path__, "igaussian_core.")
         if not m.name.rsplit(".", 1)[1].startswith("_")]
for name in names:
    importlib.import_module(name)
print(*names, sep="\\n")
print("---")
print(*sys.modules, sep="\\n")
"""
ROS_NAMES = {
    "rclpy", "rcl_interfaces", "rpyutils", "rosidl_runtime_py", "rosidl_parser",
    "ament_index_python", "builtin_interfaces", "tf2_ros", "tf2_py", "cv_bridge", "launch",
    "launch_ros", "igaussian_ros",
}  # fmt: skip


def is_ros(module: str) -> bool:
    top = module.partition(".")[0]
    return top in ROS_NAMES or top.endswith(("_msgs", "_srvs", "_interfaces"))


def module_files() -> Iterator[tuple[str, Path]]:
    for file in sorted(CORE.rglob("*.py")):
        parts = file.relative_to(CORE).with_suffix("").parts
        yield ".".join(part for part in parts if part != "__init__"), file


def imports_of(file: Path) -> Iterator[str]:
    """Absolute names of everything imported anywhere in a file, inside functions too."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative import"
            assert node.module is not None
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def core_parts_imported(file: Path) -> set[str]:
    """First-level names inside the core, e.g. {"camera", "render"}."""
    parts = set()
    for name in imports_of(file):
        first, _, rest = name.partition(".")
        if first == "igaussian_core" and rest and rest.partition(".")[0] in LAYER_OF:
            parts.add(rest.partition(".")[0])
    return parts


MODULES = [pytest.param(name, file, id=name or "__init__") for name, file in module_files()]


def test_importing_the_whole_core_loads_no_ros(no_ros_path: dict[str, str]) -> None:
    run = subprocess.run(
        [sys.executable, "-c", IMPORT_EVERYTHING], env=no_ros_path, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    imported, loaded = (part.split() for part in run.stdout.split("---"))
    assert {f"igaussian_core.{name}" for name, _ in module_files() if name} <= set(imported)
    assert [name for name in loaded if is_ros(name)] == []


@pytest.mark.parametrize(("name", "file"), MODULES)
def test_no_file_of_the_core_names_ros(name: str, file: Path) -> None:
    found = {module for module in imports_of(file) if is_ros(module)}
    if name == "cli":  # the demo goes through the node where there is one
        found = {module for module in found if not module.startswith("igaussian_ros.demo")}
    assert found == set()


@pytest.mark.parametrize(("name", "file"), MODULES)
def test_imports_go_downwards(name: str, file: Path) -> None:
    if name == "":
        return  # the package itself offers the public names
    part = name.partition(".")[0]
    assert part in LAYER_OF, f"{name}: in no layer; say where it belongs in LAYERS"
    upwards = {p for p in core_parts_imported(file) if LAYER_OF[p] > LAYER_OF[part]}
    assert upwards == set()


def test_the_stages_do_not_know_each_other() -> None:
    for name, file in module_files():
        parts = core_parts_imported(file)
        assert not (name.startswith("coarse") and "refine" in parts), name
        assert not (name.startswith("refine") and "coarse" in parts), name


def test_imports_have_no_cycle() -> None:
    graph: dict[str, set[str]] = {}
    for name, file in module_files():
        if name:
            part = name.partition(".")[0]
            graph.setdefault(part, set()).update(core_parts_imported(file) - {part})
    while graph:
        free = {part for part, needs in graph.items() if not needs & graph.keys()}
        assert free, f"a cycle among {sorted(graph)}"
        graph = {part: needs for part, needs in graph.items() if part not in free}


def test_the_import_test_can_fail(tmp_path: Path) -> None:
    file = tmp_path / "bad.py"
    file.write_text("def f():\n    from igaussian_core.localizer import Localizer\n"
                    "    import sensor_msgs.msg\n")  # fmt: skip
    assert core_parts_imported(file) == {"localizer"}
    assert [name for name in imports_of(file) if is_ros(name)] == ["sensor_msgs.msg"]


@pytest.mark.parametrize(
    "function",
    [
        Localizer.__init__, Localizer.open, Localizer.localize, Refiner.__init__, Refiner.refine,
        Refiner.align, Refiner.match, Query.__init__,
        LandmarkLocalizer.__init__, LandmarkLocalizer.hypotheses, LandmarkLocalizer.rank_views,
    ],
    ids=lambda f: f.__qualname__,
)  # fmt: skip
def test_no_estimator_can_be_given_the_truth(function: object) -> None:
    names = inspect.signature(function).parameters  # type: ignore[arg-type]
    for parameter in names.values():
        assert parameter.kind is parameter.POSITIONAL_OR_KEYWORD, "no *args or **kwargs to hide in"
        for word in ("truth", "true", "gt", "ground", "expected", "target", "label", "reference"):
            assert word not in parameter.name.lower().split("_"), parameter.name


def test_what_localize_takes_is_fixed() -> None:
    assert list(inspect.signature(Localizer.localize).parameters) == [
        "self", "image", "camera", "prior",
    ]  # fmt: skip


def test_every_error_has_one_root() -> None:
    kinds = [kind for _, kind in inspect.getmembers(errors, inspect.isclass)]
    assert len(kinds) >= 8
    for kind in kinds:
        assert issubclass(kind, errors.IGaussianError)
        assert kind.__doc__
    assert not issubclass(errors.IGaussianError, (ValueError, OSError))


def test_public_names() -> None:
    for name in igaussian_core.__all__:
        assert hasattr(igaussian_core, name)
    assert {"Localizer", "Camera", "GaussianMap", "load_map"} <= set(igaussian_core.__all__)
