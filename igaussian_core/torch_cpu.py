"""What torch does on this CPU: threads of one operation, and the precision that it is fast in."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """One thread an operation, for work whose own threads would wait beside torch's, busily."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def has_native_bfloat16() -> bool:
    """Whether the CPU computes in bfloat16: matching is then 1.6 times faster than in float32.
    Elsewhere torch imitates it, and a step of training takes nine times as long."""
    query = getattr(torch.cpu, "_is_avx512_bf16_supported", None)
    return bool(query is not None and query())
