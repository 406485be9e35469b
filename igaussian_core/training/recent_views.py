"""What the memory (`coarse/memory.py`) would say of a training image, as a loss.

The memory's regression among the views seen last stands for that among all views of the finished
memory. Gradients flow through the image's own key only, as with the queues of momentum contrast
(He et al. 2020).
"""

from __future__ import annotations

import torch
from torch import Tensor

from igaussian_core.coarse.memory import Regression, fit_regression
from igaussian_core.training.bank import Views

_MOST = 2048  # views
_LEAST = 512
_REFIT_EVERY = 128  # views
_RIDGE = 0.01


class RecentViews:
    """Keys and poses of the views that a network was trained on last, and a regression of them."""

    def __init__(self) -> None:
        self._keys, self._poses = torch.zeros(0, 0), torch.zeros(0, 12)
        self._fit: Regression | None = None
        self._new = 0

    @torch.no_grad()
    def add(self, keys: Tensor, views: Views) -> None:
        """Views that were trained on just now: raw keys [B, D] and poses."""
        self._keys = torch.cat([self._keys.reshape(-1, keys.shape[1]), keys.detach()])[-_MOST:]
        self._poses = torch.cat([self._poses, views.poses])[-_MOST:]
        self._new += len(keys)
        if len(self._keys) >= _LEAST and self._new >= _REFIT_EVERY:
            self._new = 0
            self._fit = fit_regression(self._keys, self._poses, _RIDGE)

    def predict(self, keys: Tensor) -> Tensor | None:
        """Poses [B, 12], rotation by rows and position, of raw keys; None before there are
        enough views."""
        return None if self._fit is None else self._fit.predict(keys)
