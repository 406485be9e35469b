"""Queries through an estimator, one after the other or in several processes; resumable.

The truth is kept by the queries and looked at after the estimator has answered: an estimator
is given an image, its camera and, where a protocol has one, a prior.
"""

from __future__ import annotations

import json
import resource
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from igaussian_core.camera import Camera
from igaussian_core.errors import ConfigError
from igaussian_core.evaluate.metrics import QueryOutcome, from_json, outcome, to_json
from igaussian_core.result import LocalizationResult

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]


class Estimator(Protocol):
    """Anything that localizes: `Localizer`, or a peer of the benchmarks."""

    def localize(
        self, image: NDArray[np.uint8], camera: Camera, prior: ArrayLike | None = None
    ) -> LocalizationResult:
        """As Localizer.localize."""
        ...


class Queries(Protocol):
    """A set of images with known poses."""

    def __len__(self) -> int: ...

    def name(self, index: int) -> str:
        """Unique in the set."""
        ...

    def group(self, index: int) -> str:
        """What the query is counted under."""
        ...

    def image(self, index: int) -> tuple[NDArray[np.uint8], Camera]:
        """uint8 RGB [H, W, 3] and the camera that took it."""
        ...

    def prior(self, index: int) -> Array | None:
        """T_map_cam that the estimator may start from, where the protocol has one."""
        ...

    def truth(self, index: int) -> Array:
        """T_map_cam of the query."""
        ...


@dataclass(frozen=True)
class Run:
    """Outcomes in the queries' order; `memory_mb`: most resident memory of a process."""

    outcomes: list[QueryOutcome]
    memory_mb: float


def run(
    open_estimator: Callable[[], Estimator],
    queries: Queries,
    partial: Partial | None = None,
    jobs: int = 1,
    progress: Progress = lambda done, of: None,
) -> Run:
    """Localize every query and compare with its truth.

    Args:
        open_estimator: makes the estimator; called once in each process, so picklable where
            `jobs` is above 1, and so are the queries.
        partial: keeps finished outcomes, and has those of an interrupted run.
        jobs: processes. A frame's own threads use the cores already, so that more processes
            shorten a run only where frames have few threads; latencies then are not those of
            a machine that localizes one stream.
    """
    done = partial.outcomes() if partial is not None else {}
    todo = [index for index in range(len(queries)) if queries.name(index) not in done]
    progress(len(queries) - len(todo), len(queries))
    memory_mb = 0.0
    for result, used_mb in _results(open_estimator, queries, todo, jobs):
        done[result.name] = result
        memory_mb = max(memory_mb, used_mb)
        if partial is not None:
            partial.add(result)
        progress(len(done), len(queries))
    return Run([done[queries.name(index)] for index in range(len(queries))], memory_mb)


def _results(
    open_estimator: Callable[[], Estimator], queries: Queries, todo: Sequence[int], jobs: int
) -> Iterator[tuple[QueryOutcome, float]]:
    if not todo:
        return
    if jobs == 1:
        estimator = open_estimator()
        yield from ((_localize(estimator, queries, index), _peak_mb()) for index in todo)
        return
    # forked threads of torch and OpenMP hang; a fresh interpreter does not
    with ProcessPoolExecutor(
        jobs, get_context("spawn"), initializer=_open, initargs=(open_estimator, queries)
    ) as pool:
        yield from pool.map(_localize_there, todo)


def _localize(estimator: Estimator, queries: Queries, index: int) -> QueryOutcome:
    image, camera = queries.image(index)
    result = estimator.localize(image, camera, queries.prior(index))
    return outcome(queries.name(index), result, queries.truth(index), queries.group(index))


_PROCESS: list[tuple[Estimator, Queries]] = []  # of a worker process


def _open(open_estimator: Callable[[], Estimator], queries: Queries) -> None:
    _PROCESS.append((open_estimator(), queries))


def _localize_there(index: int) -> tuple[QueryOutcome, float]:
    estimator, queries = _PROCESS[0]
    return _localize(estimator, queries, index), _peak_mb()


def _peak_mb() -> float:
    """Most resident memory of this process so far; Linux counts it in kB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e6


class Partial:
    """Outcomes of a run under way, one JSON line each, so that an interrupted one goes on.

    Args:
        path: of the .jsonl file.
        key: says what is run; a file of another run is begun anew.
    """

    def __init__(self, path: Path, key: str) -> None:
        self._path = path
        self._key = key
        self._outcomes = self._read()
        if not self._outcomes:
            self._write_line({"run": key}, "w")

    def outcomes(self) -> dict[str, QueryOutcome]:
        """Finished ones by name."""
        return dict(self._outcomes)

    def add(self, result: QueryOutcome) -> None:
        """Keep one; on disk when this returns."""
        self._write_line(to_json(result), "a")

    def remove(self) -> None:
        """The run is finished."""
        self._path.unlink(missing_ok=True)

    def _write_line(self, data: dict[str, object], mode: str) -> None:
        try:
            with open(self._path, mode, encoding="utf-8") as stream:
                stream.write(json.dumps(data) + "\n")
        except OSError as error:
            raise ConfigError(f"{self._path}: cannot be written: {error}") from error

    def _read(self) -> dict[str, QueryOutcome]:
        try:
            head, *lines = self._path.read_text(encoding="utf-8").splitlines()
            if json.loads(head) != {"run": self._key}:
                return {}
        except (OSError, ValueError):
            return {}
        found = {}
        for line in lines:
            try:
                result = from_json(json.loads(line))
            except (ValueError, LookupError, TypeError):
                break  # the line that an interruption cut off
            found[result.name] = result
        if len(found) < len(lines):
            kept = "".join(f"{line}\n" for line in [head, *lines[: len(found)]])
            self._path.write_text(kept, encoding="utf-8")
        return found
