"""Milliseconds by stage of the pipeline."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


class StageTimer:
    """`with timer("match"): ...` adds to the stage's time; `timings_ms` has them and `total`."""

    def __init__(self) -> None:
        self._start = time.perf_counter()
        self._stages: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            elapsed = 1e3 * (time.perf_counter() - start)
            self._stages[stage] = self._stages.get(stage, 0.0) + elapsed

    def elapsed_ms(self) -> float:
        """Milliseconds since the start."""
        return 1e3 * (time.perf_counter() - self._start)

    def timings_ms(self) -> dict[str, float]:
        """Stages in the order of their first use, and the total since the start."""
        return {**self._stages, "total": self.elapsed_ms()}
