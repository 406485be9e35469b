"""What `ros2 run igaussian_ros localizer` needs, from a wheel and from a colcon workspace.

ros2cli is not among the packages of PyPI; ament's index and the files under lib/ are all that it
looks at.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import sysconfig
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
from harness import ROOT, Spinning, replay_process, wait_until

from igaussian_ros.listener import Listener

_NOT_SOURCE = shutil.ignore_patterns(
    ".*", "build", "dist", "install", "log", "out", "*.egg-info", "__pycache__", "*.so", "tests"
)


@dataclass(frozen=True)
class Installation:
    """An ament prefix and the environment variables that a sourced workspace would have."""

    prefix: Path
    python: Path
    variables: dict[str, str]

    @property
    def environment(self) -> dict[str, str]:
        return {**os.environ, "AMENT_PREFIX_PATH": str(self.prefix), **self.variables}

    def ask(self, code: str) -> str:
        """What a statement prints in this installation's Python."""
        return _run([self.python, "-c", code], self.prefix, self.environment).strip()


def _run(command: list[object], folder: Path, environment: dict[str, str] | None = None) -> str:
    done = subprocess.run(
        [str(part) for part in command],
        cwd=folder,
        env=environment,
        text=True,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        timeout=300,
    )
    assert done.returncode == 0, f"{command}\n{done.stdout[-3000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the project, so that building leaves nothing in the checkout."""
    folder = tmp_path_factory.mktemp("workspace") / "src" / "igaussian"
    shutil.copytree(ROOT, folder, ignore=_NOT_SOURCE)
    return folder


def _by_wheel(source: Path, folder: Path) -> Installation:
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    _run([*pip, "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", folder, source], folder)
    (wheel,) = folder.glob("*.whl")
    prefix = folder / "environment"
    _run([sys.executable, "-m", "venv", "--without-pip", prefix], folder)
    python = prefix / "bin" / "python"
    _run([*pip, "--python", python, "install", "-q", "--no-deps", "--no-index", wheel], folder)
    # the dependencies of the tests' own environment, without its editable installation
    (packages,) = prefix.glob("lib/python*/site-packages")
    others = {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}
    (packages / "others.pth").write_text("\n".join(sorted(others)))
    path = f"{prefix / 'bin'}{os.pathsep}{os.environ['PATH']}"
    return Installation(prefix, python, {"PATH": path, "PYTHONPATH": ""})


def _by_colcon(source: Path, folder: Path) -> Installation:
    colcon = Path(sysconfig.get_path("scripts")) / "colcon"
    if not colcon.exists():
        pytest.skip("colcon is not installed: pip install -e '.[test]'")
    _run(
        [colcon, "--log-base", folder / "log", "build", "--base-paths", source,
         "--build-base", folder / "build", "--install-base", folder / "install"],
        folder,
    )  # fmt: skip
    prefix = folder / "install" / "igaussian_ros"
    (packages,) = prefix.glob("lib/python*/site-packages")
    return Installation(prefix, Path(sys.executable), {"PYTHONPATH": str(packages)})


@pytest.fixture(scope="module", params=[_by_wheel, _by_colcon], ids=["wheel", "colcon"])
def installed(
    request: pytest.FixtureRequest, source: Path, tmp_path_factory: pytest.TempPathFactory
) -> Installation:
    return request.param(source, tmp_path_factory.mktemp("route"))


def test_ament_finds_the_package(installed: Installation) -> None:
    code = (
        "from ament_index_python.packages import get_package_prefix as p, "
        "get_package_share_directory as s; print(p('igaussian_ros')); print(s('igaussian_ros'))"
    )
    prefix, share = installed.ask(code).splitlines()
    assert Path(prefix) == installed.prefix
    for name in ("package.xml", "launch/localizer.launch.py", "msg_configs/localizer.yaml"):
        assert (Path(share) / name).is_file(), name


def test_one_executable(installed: Installation) -> None:
    found = [p for p in (installed.prefix / "lib" / "igaussian_ros").rglob("*") if p.is_file()]
    executables = sorted(p.name for p in found if os.access(p, os.X_OK))
    assert executables.count("localizer") == 1
    assert executables.count("replay") == 1


def test_the_installed_code_and_files_are_used(installed: Installation) -> None:
    code = (
        "import igaussian_core, igaussian_ros; from igaussian_core.resources import resource; "
        "print(igaussian_core.__file__); print(igaussian_ros.__file__); "
        "print(resource('msg_configs/localizer.yaml')); print(resource('launch'))"
    )
    for line in installed.ask(code).splitlines():
        assert Path(line).is_relative_to(installed.prefix), line


def test_the_shipped_weights_are_installed(installed: Installation) -> None:
    code = (
        "from igaussian_core.refine.scale_vit import WEIGHTS, load_scale_vit; "
        "load_scale_vit(WEIGHTS); print(WEIGHTS)"
    )
    assert Path(installed.ask(code)).is_relative_to(installed.prefix)


def test_the_bundled_demo_is_installed(installed: Installation) -> None:
    code = "from igaussian_core.resources import resource; print(resource('bags/demo'))"
    if not (ROOT / "bags" / "demo" / "drive").is_dir():
        pytest.skip("no bundled demo in this checkout")
    demo = Path(installed.ask(code))
    for name in ("room.ply", "mapping_cameras.json", "drive/metadata.yaml"):
        assert (demo / name).is_file()
    assert demo.is_relative_to(installed.prefix)


def test_it_runs_localizes_and_ends(installed: Installation, corner, ros, tmp_path: Path) -> None:
    """As ros2 run starts it: the executable, ROS arguments, SIGINT to the process group."""
    executable = installed.prefix / "lib" / "igaussian_ros" / "localizer"
    parameters = installed.prefix / "share/igaussian_ros/msg_configs/localizer.yaml"
    command = [
        str(executable), "--ros-args", "--params-file", str(parameters),
        "-p", f"map_path:={corner.map_path}", "-p", "image_transport:=compressed",
    ]  # fmt: skip
    log = tmp_path / "node.log"
    with log.open("wb") as stream, Spinning(Listener(truth_topic=None)) as listener:
        process = subprocess.Popen(
            command, cwd=tmp_path, env=installed.environment, stdin=subprocess.DEVNULL,
            stdout=stream, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
        try:
            assert wait_until(lambda: listener.diagnostics.get("map"), 60), log.read_text()
            with replay_process(
                tmp_path, corner.bag, "--stamp", "now", "--loop", "0",
                "--wait-for-subscribers", "20",
            ):  # fmt: skip
                assert wait_until(lambda: listener.poses, 60), log.read_text()
            begin = time.monotonic()
            os.killpg(process.pid, signal.SIGINT)
            assert process.wait(30) == 0, log.read_text()
            assert time.monotonic() - begin < 5.0
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
