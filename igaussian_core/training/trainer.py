"""What every training of a pose network shares: steps by threads, resumption, the curve."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from igaussian_core.coarse.attention import PoseNetwork
from igaussian_core.errors import ConfigError
from igaussian_core.torch_cpu import has_native_bfloat16, one_torch_thread

Progress = Callable[[str, int, int], None]


class Options(Protocol):
    """What a trainer reads of its options, which are a dataclass."""

    @property
    def steps(self) -> int: ...
    @property
    def learning_rate(self) -> float: ...
    @property
    def clip(self) -> float: ...
    @property
    def seed(self) -> int: ...
    @property
    def validate_every(self) -> int: ...


@dataclass
class Curve:
    """What training wrote down: step, and figures by name."""

    steps: list[int] = field(default_factory=list)
    values: dict[str, list[float]] = field(default_factory=dict)

    def add(self, step: int, **values: float) -> None:
        self.steps.append(step)
        for name, value in values.items():
            self.values.setdefault(name, []).append(value)


class Trainer(ABC):
    """Trains a network; `run` may be called again after an interruption.

    The work of a step comes in shares. Each goes through a copy of the network that has the same
    parameters; the gradients are averaged. Two threads with a share each take little more than half
    the time of one; sharing each operation among them gains next to nothing, networks being small.

    Args:
        network: starts from its weights.
        options: a dataclass.
        shares: of a step.
        checkpoint: file that an interrupted training goes on from; None: none is written.
        threads: at most so many shares at a time.
        device: of network and shares: cpu, or cuda for a training of many maps.

    Raises:
        ConfigError: `checkpoint` is there, but unreadable or of other options.
    """

    def __init__(
        self, network: PoseNetwork, options: Options, shares: int,
        checkpoint: Path | None = None, threads: int = 2, device: str = "cpu",
    ) -> None:  # fmt: skip
        network = network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.network = network
        self.curve = Curve()
        self.save_every = 500  # steps
        self.step = 0
        self._plan, self._threads = options, min(threads, shares)
        self._rng = np.random.default_rng(options.seed)
        self._copies = [network, *(_sharing_copy(network) for _ in range(shares - 1))]
        self._randoms = [
            torch.Generator(device).manual_seed(1000 * options.seed + i) for i in range(shares)
        ]
        self._optimizer = torch.optim.AdamW(
            network.parameters(), lr=options.learning_rate, weight_decay=0.02, fused=True
        )
        self._schedule = torch.optim.lr_scheduler.OneCycleLR(
            self._optimizer, options.learning_rate, total_steps=max(options.steps, 1),
            pct_start=0.15,
        )
        self._checkpoint = checkpoint
        if checkpoint is not None and checkpoint.is_file():
            self._resume(checkpoint)

    @abstractmethod
    def _draw(self) -> Sequence[Any]:
        """The shares of a step."""

    @abstractmethod
    def _gradients(
        self, network: PoseNetwork, random: torch.Generator, share: Any
    ) -> tuple[float, Any]:
        """Leaves the gradients of a share in `network`; its loss, and what `_learned` wants."""

    @abstractmethod
    def _errors(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Degrees [N] and lengths [N] on views held out, of the network as it is."""

    def _renew(self) -> None:  # noqa: B027 - not every training has something to renew
        """Called beside every step, which it must not disturb."""

    def _learned(self, results: Sequence[Any]) -> None:  # noqa: B027 - nor looks back
        """Called after every step with what each share's `_gradients` gave."""

    def run(self, progress: Progress = lambda stage, done, of: None) -> Curve:
        """Train to the end; the network is in evaluation mode afterwards."""
        plan = self._plan
        for network in self._copies:
            network.train()
        with (
            one_torch_thread(), ThreadPoolExecutor(1) as beside,
            ThreadPoolExecutor(self._threads, initializer=torch.set_num_threads,
                               initargs=(1,)) as workers,
        ):  # fmt: skip
            pending = beside.submit(lambda: None)
            losses: list[float] = []  # since the last validation
            while self.step < plan.steps:
                pending.result()
                shares = self._draw()
                pending = beside.submit(self._renew)
                losses.append(self._learn(shares, workers))
                self.step += 1
                if self.step % plan.validate_every == 0 or self.step == plan.steps:
                    self._note(float(np.mean(losses)))
                    losses.clear()
                if self._checkpoint is not None and self.step % self.save_every == 0:
                    self._save(self._checkpoint)
                progress("training", self.step, plan.steps)
            pending.result()
        self.network.eval()
        if self._checkpoint is not None:
            self._checkpoint.unlink(missing_ok=True)
        return self.curve

    def _note(self, loss: float) -> None:
        degrees, lengths = self._errors()
        self.curve.add(
            self.step, loss=loss, degrees=float(np.median(degrees)),
            lengths=float(np.median(lengths)), within_15=float((degrees < 15).mean()),
            learning_rate=float(self._schedule.get_last_lr()[0]),
        )  # fmt: skip

    def _learn(self, shares: Sequence[Any], workers: ThreadPoolExecutor) -> float:
        """One step of the optimiser; the mean loss."""
        results = list(workers.map(self._gradients, self._copies, self._randoms, shares))
        self._learned([extra for _, extra in results])
        for ours, *theirs in zip(*(n.parameters() for n in self._copies), strict=True):
            for parameter in theirs:
                if ours.grad is not None and parameter.grad is not None:
                    ours.grad += parameter.grad
            if ours.grad is not None:
                ours.grad /= len(self._copies)
        nn.utils.clip_grad_norm_(self.network.parameters(), self._plan.clip)
        self._optimizer.step()
        self._schedule.step()
        return float(np.mean([loss for loss, _ in results]))

    def _save(self, path: Path) -> None:
        state = {
            "options": asdict(self._plan),  # type: ignore[call-overload]
            "step": self.step,
            "network": self.network.state_dict(), "optimizer": self._optimizer.state_dict(),
            "schedule": self._schedule.state_dict(), "curve": asdict(self.curve),
            "random": [random.get_state() for random in self._randoms],
        }  # fmt: skip
        temporary = path.with_name(path.name + ".new")
        torch.save(state, temporary)
        temporary.replace(path)

    def _resume(self, path: Path) -> None:
        try:
            state: dict[str, Any] = torch.load(path, weights_only=True)
        except Exception as error:  # pickle and zip raise types of their own
            raise ConfigError(f"{path}: unreadable checkpoint: {error}") from error
        if state["options"] != asdict(self._plan):  # type: ignore[call-overload]
            raise ConfigError(f"{path}: checkpoint of a training with other options; remove it")
        self.network.load_state_dict(state["network"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._schedule.load_state_dict(state["schedule"])
        for random, saved in zip(self._randoms, state["random"], strict=False):
            random.set_state(saved)
        self.step = int(state["step"])
        self._rng = np.random.default_rng([self._plan.seed, self.step])
        self.curve = Curve(**state["curve"])


def mixed_precision(device: str = "cpu", enabled: bool = True) -> torch.autocast:
    """bfloat16 where the device computes in it. Without autocast's cache of weights, which is the
    process's: another thread would empty it halfway."""
    native = device != "cpu" or has_native_bfloat16()
    return torch.autocast(device, torch.bfloat16, enabled=enabled and native, cache_enabled=False)


def _sharing_copy(network: PoseNetwork) -> PoseNetwork:
    """The same parameters; gradients and statistics of its own."""
    other = copy.deepcopy(network)
    for ours, theirs in zip(network.parameters(), other.parameters(), strict=True):
        theirs.data = ours.data
    return other
