"""A worker thread that always takes the newest frame; knows nothing of ROS.

Processing in a subscription callback lets frames queue up and grow stale; one slot that a new
frame overwrites keeps the age of a frame at the start of work near zero.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

log = logging.getLogger(__name__)
Item = TypeVar("Item")


@dataclass(frozen=True)
class WorkerStats:
    """Counts since the start."""

    received: int
    processed: int
    dropped: int  # overwritten by a newer frame before work on them began
    failed: int  # the handler raised


class NewestFrameWorker(Generic[Item]):
    """Calls `handle(item)` on its own thread, for the newest submitted item only.

    `call(fn)` runs a function on the same thread between two items, so that whatever `handle`
    uses needs no lock. Exceptions of `handle` are logged and counted; the thread lives on.
    """

    def __init__(self, handle: Callable[[Item], None], name: str = "localizer-worker") -> None:
        self._handle = handle
        self._condition = threading.Condition()
        self._item: Item | None = None
        self._calls: list[tuple[Callable[[], Any], Future[Any]]] = []
        self._stopping = False
        self._busy = False
        self._received = self._processed = self._dropped = self._failed = 0
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def submit(self, item: Item) -> None:
        """Offer an item; one that still waits is dropped. Never blocks."""
        with self._condition:
            if self._stopping:
                return
            self._received += 1
            self._dropped += self._item is not None
            self._item = item
            self._condition.notify_all()

    def call(self, function: Callable[[], Any]) -> Future[Any]:
        """Run a function on the worker's thread before the next item; its result as a Future."""
        future: Future[Any] = Future()
        with self._condition:
            if self._stopping:
                future.set_exception(RuntimeError("the worker has stopped"))
            else:
                self._calls.append((function, future))
                self._condition.notify_all()
        return future

    def drain(self, timeout_s: float) -> bool:
        """Wait until nothing is pending; False on timeout."""
        deadline = time.monotonic() + timeout_s
        with self._condition:
            while self._item is not None or self._calls or self._busy:
                remaining = deadline - time.monotonic()
                if remaining <= 0:
                    return False
                self._condition.wait(remaining)
        return True

    def stats(self) -> WorkerStats:
        with self._condition:
            return WorkerStats(self._received, self._processed, self._dropped, self._failed)

    def stop(self, timeout_s: float = 10.0) -> bool:
        """Finish the item at hand, drop the waiting one, join. False where it still runs."""
        with self._condition:
            self._stopping = True
            self._item = None
            self._condition.notify_all()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._condition:
                self._busy = False
                self._condition.notify_all()
                while not (self._item is not None or self._calls or self._stopping):
                    self._condition.wait()
                calls, self._calls = self._calls, []
                item, self._item = self._item, None
                stopping = self._stopping
                self._busy = True
            for function, future in calls:
                _run_call(function, future)
            if stopping:
                with self._condition:
                    self._busy = False
                    self._condition.notify_all()
                return
            if item is not None:
                self._process(item)

    def _process(self, item: Item) -> None:
        failed = False
        try:
            self._handle(item)
        except Exception:
            failed = True
            log.exception("a frame could not be processed")
        with self._condition:
            self._processed += 1
            self._failed += failed


def _run_call(function: Callable[[], Any], future: Future[Any]) -> None:
    if not future.set_running_or_notify_cancel():
        return
    try:
        future.set_result(function())
    except Exception as error:
        future.set_exception(error)
