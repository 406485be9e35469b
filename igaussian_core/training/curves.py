"""Curves of a training: as a picture, and as TensorBoard reads them."""

from __future__ import annotations

from pathlib import Path

from igaussian_core.training.trainer import Curve

_TITLES = {
    "loss": "loss", "degrees": "rotation error on held-out views, median degrees",
    "lengths": "position error on held-out views, median share of the map's length",
    "within_15": "share of held-out views within 15 degrees",
}  # fmt: skip


def plot_curve(curve: Curve, path: Path) -> None:
    """A picture of the figures over the steps."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(2, 2, figsize=(10, 6), layout="constrained")
    for axis, (name, title) in zip(axes.flat, _TITLES.items(), strict=True):
        axis.plot(curve.steps, curve.values[name], marker=".")
        axis.set(title=title, xlabel="steps")
        axis.title.set_fontsize(9)
        axis.grid(alpha=0.3)
        if name != "within_15":
            axis.set_yscale("log")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def write_tensorboard(curve: Curve, folder: Path) -> None:
    """An event file of the figures."""
    from tensorboardX import SummaryWriter

    with SummaryWriter(str(folder)) as writer:
        for name, values in curve.values.items():
            for step, value in zip(curve.steps, values, strict=True):
                writer.add_scalar(name, value, step)
