"""Checkpoints of nerfstudio's splatfacto: `nerfstudio_models/step-*.ckpt`.

Read with torch's weights_only loader, so that no code of the file runs. The frame is
nerfstudio's own: `dataparser_transforms.json` says how it lies to the poses that were given.
"""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from igaussian_core.errors import MapError
from igaussian_core.formats.raw import RawGaussians

_PREFIXES = ("_model.gauss_params.", "_model.", "gauss_params.")
_NAMES = ("means", "quats", "scales", "opacities", "features_dc", "features_rest")


def read(file: Path) -> RawGaussians:
    """Gaussians of a checkpoint.

    Raises:
        MapError: no checkpoint of splatfacto, or one that holds more than plain data.
    """
    import torch

    try:
        data = torch.load(file, map_location="cpu", weights_only=True)
    except (RuntimeError, pickle.UnpicklingError, EOFError, ValueError) as error:
        raise MapError(
            f"{file}: not readable as plain data ({str(error).splitlines()[0]}); write a .ply with "
            "`ns-export gaussian-splat`"
        ) from error
    state = data.get("pipeline") if isinstance(data, dict) else None
    found = _parameters(state) if isinstance(state, dict) else {}
    missing = [name for name in _NAMES if name not in found]
    if missing:
        raise MapError(f"{file}: no checkpoint of splatfacto: lacks {', '.join(missing)}")
    count = len(found["means"])
    if any(len(array) != count for array in found.values()):
        raise MapError(f"{file}: its arrays are of different lengths")
    sh = np.concatenate(
        [found["features_dc"].reshape(count, 1, 3), found["features_rest"].reshape(count, -1, 3)],
        axis=1,
    )
    return RawGaussians(
        means=found["means"],
        quats_wxyz=found["quats"],
        scales=np.exp(found["scales"]),
        opacities=(1 / (1 + np.exp(-found["opacities"].reshape(count)))).astype(np.float32),
        sh=np.ascontiguousarray(sh),
        file_format="nerfstudio checkpoint",
        vertical_axis="z",
    )


def _parameters(state: dict[str, object]) -> dict[str, NDArray[np.float32]]:
    found = {}
    for name in _NAMES:
        for prefix in _PREFIXES:
            tensor = state.get(prefix + name)
            if hasattr(tensor, "numpy"):
                found[name] = np.asarray(tensor.float().numpy(), np.float32)  # type: ignore[attr-defined]
                break
    return found
