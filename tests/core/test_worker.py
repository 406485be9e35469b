"""Newest frame only, exact counts, survived exceptions, calls between frames, stop."""

from __future__ import annotations

import logging
import threading
from concurrent.futures import Future
from typing import Any

import pytest

from igaussian_core.worker import NewestFrameWorker

WAIT_S = 20.0  # far more than needed: it bounds a failure only


class Gate:
    """A handler that stays inside until it is let go, and remembers what it was given."""

    def __init__(self) -> None:
        self.seen: list[Any] = []
        self.threads: set[int] = set()
        self.entered = threading.Semaphore(0)
        self.leave = threading.Semaphore(0)

    def __call__(self, item: Any) -> None:
        self.seen.append(item)
        self.threads.add(threading.get_ident())
        self.entered.release()
        assert self.leave.acquire(timeout=WAIT_S)

    def wait_inside(self) -> None:
        assert self.entered.acquire(timeout=WAIT_S)


def counts(worker: NewestFrameWorker[Any]) -> tuple[int, int, int, int]:
    s = worker.stats()
    return s.received, s.processed, s.dropped, s.failed


def test_only_the_newest_waits() -> None:
    gate = Gate()
    worker: NewestFrameWorker[int] = NewestFrameWorker(gate)
    worker.submit(0)
    gate.wait_inside()
    for item in range(1, 6):  # all while the first is in work
        worker.submit(item)
    assert counts(worker) == (6, 0, 4, 0)
    gate.leave.release()
    gate.wait_inside()
    gate.leave.release()
    assert worker.drain(WAIT_S)
    assert gate.seen == [0, 5]
    assert counts(worker) == (6, 2, 4, 0)
    assert worker.stop(WAIT_S)


def test_one_thread_does_the_work_and_not_the_callers() -> None:
    gate = Gate()
    worker: NewestFrameWorker[int] = NewestFrameWorker(gate)
    for item in range(3):
        worker.submit(item)
        gate.wait_inside()
        gate.leave.release()
        assert worker.drain(WAIT_S)
    assert gate.seen == [0, 1, 2]
    assert len(gate.threads) == 1 and threading.get_ident() not in gate.threads
    assert worker.stop(WAIT_S)


def test_exceptions_are_logged_and_counted_and_survived(caplog: pytest.LogCaptureFixture) -> None:
    seen = []

    def handle(item: int) -> None:
        seen.append(item)
        if item % 2:
            raise ValueError(f"frame {item} is broken")

    worker: NewestFrameWorker[int] = NewestFrameWorker(handle)
    with caplog.at_level(logging.ERROR):
        for item in range(4):
            worker.submit(item)
            assert worker.drain(WAIT_S)
    assert seen == [0, 1, 2, 3]
    assert counts(worker) == (4, 4, 0, 2)
    assert "frame 3 is broken" in caplog.text
    assert worker.stop(WAIT_S)


def test_none_is_an_item_too() -> None:
    """Counts stay right whatever is submitted."""
    seen: list[Any] = []
    worker: NewestFrameWorker[Any] = NewestFrameWorker(seen.append)
    worker.submit(False)
    assert worker.drain(WAIT_S)
    assert seen == [False]
    assert worker.stop(WAIT_S)


def test_calls_run_on_the_workers_thread_before_the_next_item() -> None:
    gate, order = Gate(), []
    worker: NewestFrameWorker[str] = NewestFrameWorker(
        lambda item: (order.append(item), gate(item))[1]
    )
    worker.submit("first")
    gate.wait_inside()
    worker.submit("second")

    def call(name: str) -> int:
        order.append(name)
        return threading.get_ident()

    futures: list[Future[int]] = [worker.call(lambda n=n: call(n)) for n in ("call a", "call b")]
    assert not futures[0].done()  # the first item is still in work
    gate.leave.release()
    gate.leave.release()
    assert {f.result(WAIT_S) for f in futures} == gate.threads
    assert worker.drain(WAIT_S)
    assert order == ["first", "call a", "call b", "second"]
    assert counts(worker) == (2, 2, 0, 0)  # calls are no frames
    assert worker.stop(WAIT_S)


def test_a_calls_exception_reaches_its_caller() -> None:
    seen: list[int] = []
    worker: NewestFrameWorker[int] = NewestFrameWorker(seen.append)

    def broken() -> None:
        raise KeyError("service failed")

    with pytest.raises(KeyError, match="service failed"):
        worker.call(broken).result(WAIT_S)
    worker.submit(1)
    assert worker.drain(WAIT_S)
    assert seen == [1] and worker.stats().failed == 0
    assert worker.stop(WAIT_S)


def test_stop_finishes_the_item_at_hand_and_drops_the_waiting_one() -> None:
    gate = Gate()
    worker: NewestFrameWorker[int] = NewestFrameWorker(gate)
    worker.submit(1)
    gate.wait_inside()
    worker.submit(2)
    assert not worker.stop(timeout_s=0.05)  # still inside
    gate.leave.release()
    assert worker.stop(WAIT_S)
    assert gate.seen == [1]


def test_after_stop_nothing_is_taken_and_nothing_hangs() -> None:
    seen: list[int] = []
    worker: NewestFrameWorker[int] = NewestFrameWorker(seen.append)
    assert worker.stop(WAIT_S) and worker.stop(WAIT_S)
    worker.submit(1)
    with pytest.raises(RuntimeError, match="stopped"):
        worker.call(lambda: 1).result(WAIT_S)
    assert worker.drain(1.0)
    assert seen == [] and counts(worker)[0] == 0


def test_drain_gives_up_in_time() -> None:
    gate = Gate()
    worker: NewestFrameWorker[int] = NewestFrameWorker(gate)
    worker.submit(1)
    gate.wait_inside()
    assert not worker.drain(0.05)
    gate.leave.release()
    assert worker.drain(WAIT_S)
    assert worker.stop(WAIT_S)


def test_counts_hold_under_many_submitters() -> None:
    seen: list[int] = []
    worker: NewestFrameWorker[int] = NewestFrameWorker(seen.append)
    threads = [
        threading.Thread(target=lambda: [worker.submit(i) for i in range(200)]) for _ in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(WAIT_S)
    assert worker.drain(WAIT_S)
    received, processed, dropped, failed = counts(worker)
    assert received == 800 and failed == 0
    assert processed == len(seen) and processed + dropped == 800
    assert worker.stop(WAIT_S)
