"""Warnings that are said at once, then at most every few seconds, with a count."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

_MOST_KEYS = 1000


def key_of(text: str) -> str:
    """The text without its numbers and hexadecimal bytes: equal mistakes have equal keys."""
    return re.sub(r"\b[0-9a-f]{2}\b|\d+", "#", text)


@dataclass
class _Seen:
    said_at: float
    suppressed: int = 0


class Throttle:
    """Says a text at most once a period for each key, by the wall clock.

    A ROS clock stands still while a bag is paused, and that is when warnings are needed.
    """

    def __init__(
        self,
        say: Callable[[str], object],
        period_s: float = 5.0,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._say = say
        self._period_s = period_s
        self._now = now
        self._seen: dict[str, _Seen] = {}
        self._lock = threading.Lock()

    def __call__(self, key: str, text: str) -> None:
        """Say the text unless something with this key was said less than a period ago."""
        now = self._now()
        with self._lock:
            seen = self._seen.get(key)
            if seen is not None and now - seen.said_at < self._period_s:
                seen.suppressed += 1
                return
            suppressed = seen.suppressed if seen else 0
            if len(self._seen) >= _MOST_KEYS:
                self._seen.clear()
            self._seen[key] = _Seen(now)
        self._say(f"{text} ({suppressed} more of these since)" if suppressed else text)
