"""Processes and a ROS client for the tests of the node."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.node import Node

ROOT = Path(__file__).resolve().parents[2]


def wait_until(condition: Callable[[], Any], timeout_s: float = 20.0) -> bool:
    """True as soon as the condition holds; False after the timeout."""
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.02)
    return bool(condition())


class Process:
    """A Python module as a process group of its own; a context manager that ends it."""

    def __init__(self, module: str, arguments: list[str], folder: Path, **variables: str) -> None:
        paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, paths))}
        self._log = folder / f"{module.rpartition('.')[2]}-{time.monotonic_ns()}.log"
        with self._log.open("wb") as stream:
            self.popen = subprocess.Popen(
                [sys.executable, "-m", module, *arguments],
                stdout=stream,
                stderr=subprocess.STDOUT,
                env={**environment, **variables},
                cwd=folder,
                start_new_session=True,
            )

    @property
    def log(self) -> str:
        return self._log.read_text(errors="replace")

    def says(self, text: str, timeout_s: float = 20.0) -> bool:
        """Wait until the text appears in the output."""
        return wait_until(lambda: text in self.log, timeout_s)

    def end(self, number: int = signal.SIGINT, timeout_s: float = 10.0) -> int:
        """Send a signal to the process group; the exit status."""
        if self.popen.poll() is None:
            os.killpg(self.popen.pid, number)
        return self.popen.wait(timeout_s)

    def __enter__(self) -> Process:
        return self

    def __exit__(self, *_: object) -> None:
        if self.popen.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.popen.pid, signal.SIGKILL)
        self.popen.wait(10)


def node_process(folder: Path, *remaps: str, **parameters: Any) -> Process:
    """The localizer with parameters; `a__b` is the parameter a.b."""
    arguments = ["--ros-args"]
    for name, value in parameters.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        arguments += ["-p", f"{name.replace('__', '.')}:={text}"]
    for remap in remaps:
        arguments += ["-r", remap]
    return Process("igaussian_ros.localizer_node", arguments, folder)


def replay_process(folder: Path, bag: Path, *arguments: str) -> Process:
    return Process("igaussian_ros.replay", [str(bag), *arguments], folder)


class Spinning:
    """Spins a node on a thread; a context manager that takes both down."""

    def __init__(self, node: Node) -> None:
        self.node = node
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(node)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._spin)

    def _spin(self) -> None:
        while not self._over.is_set():
            with contextlib.suppress(ExternalShutdownException):
                self._executor.spin_once(timeout_sec=0.05)

    def __enter__(self) -> Any:
        self._thread.start()
        return self.node

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        self._executor.shutdown()
        self.node.destroy_node()


def call(node: Node, kind: Any, name: str, request: Any = None, timeout_s: float = 20.0) -> Any:
    """Call a service through a node that is spun elsewhere."""
    client = node.create_client(kind, name)
    assert client.wait_for_service(timeout_s), f"no service {name}"
    future = client.call_async(request or kind.Request())
    assert wait_until(future.done, timeout_s), f"no answer from {name}"
    node.destroy_client(client)
    return future.result()


def init_ros() -> None:
    if not rclpy.ok():
        rclpy.init()
