"""Renders to files: pictures, depth pictures, and orbits as folders of pictures or videos."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from igaussian_core.errors import ImageError

Image = NDArray[np.uint8]
Depth = NDArray[np.float32]

VIDEO_SUFFIXES = (".mp4", ".gif")
_MOST_DEPTH = 65535


def to_uint8(rgb: NDArray[np.float32]) -> Image:
    """Colours of [0, 1] as uint8, rounded and clipped."""
    return np.asarray(np.clip(rgb * 255 + 0.5, 0, 255), np.uint8)


def write_picture(path: Path, image: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Write RGB [H, W, 3], or one channel [H, W], in the format that the name ends with.

    Raises:
        ImageError: a place or a suffix that cannot be written.
    """
    pixels = image[..., ::-1] if image.ndim == 3 else image
    try:
        written = cv2.imwrite(str(path), np.ascontiguousarray(pixels))
    except cv2.error:
        written = False
    if not written:
        raise ImageError(f"{path}: cannot be written; supported: .png, .jpg in an existing folder")


def depth_scale(depth: Depth) -> float:
    """Steps a scene unit: 1000, or the largest power of ten with which 16 bits reach far enough.

    Far floaters are cut: the farthest 0.1 % of the pixels may saturate.
    """
    seen = depth[depth > 0]
    far = float(np.percentile(seen, 99.9)) if len(seen) else 1.0
    return float(10.0 ** min(3, np.floor(np.log10(_MOST_DEPTH / max(far, 1e-9)))))


def depth_steps(depth: Depth, scale: float) -> NDArray[np.uint16]:
    """Depth [H, W] as 16 bits, 0 where there is none."""
    return np.asarray(np.clip(depth * scale + 0.5, 0, _MOST_DEPTH), np.uint16)


def colour_depth(depth: Depth, alpha: Depth) -> Image:
    """Depth for the eye, RGB [H, W, 3]: near is red, far is blue, nothing is black.

    Inverse depth between its 2nd and 98th percentile, so that near things have the contrast.
    """
    solid = (alpha > 0.5) & (depth > 0)
    if not solid.any():
        return np.zeros((*depth.shape, 3), np.uint8)
    inverse = 1 / np.where(solid, depth, 1)
    low, high = np.percentile(inverse[solid], [2, 98])
    unit = np.clip((inverse - low) / max(high - low, 1e-12), 0, 1)
    colours = cv2.applyColorMap((unit * 255).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1]
    return np.asarray(np.where(solid[..., None], colours, 0), np.uint8)


def write_sequence(path: Path, frames: Iterator[Image], frames_per_second: float) -> int:
    """Write frames of one size to a .mp4 or .gif, else as 000.png, 001.png... into a folder.

    Returns:
        How many were written.

    Raises:
        ImageError: a place that cannot be written, or a video format that OpenCV lacks.
    """
    suffix = path.suffix.lower()
    if suffix in VIDEO_SUFFIXES and not path.parent.is_dir():
        raise ImageError(f"{path}: no such folder")
    if suffix == ".mp4":
        return _write_mp4(path, frames, frames_per_second)
    if suffix == ".gif":
        return _write_gif(path, frames, frames_per_second)
    if suffix:
        raise ImageError(f"{path}: supported: .mp4, .gif, or a folder's name without a suffix")
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ImageError(f"{path}: cannot be made: {error.strerror}") from error
    count = 0
    for count, frame in enumerate(frames, 1):
        write_picture(path / f"{count - 1:03d}.png", frame)
    return count


def _write_mp4(path: Path, frames: Iterator[Image], frames_per_second: float) -> int:
    writer, count = None, 0
    for frame in frames:
        if writer is None:
            size = (frame.shape[1] // 2 * 2, frame.shape[0] // 2 * 2)  # codecs want even sizes
            code = cv2.VideoWriter.fourcc(*"mp4v")
            writer = cv2.VideoWriter(str(path), code, frames_per_second, size)
            if not writer.isOpened():
                raise ImageError(f"{path}: OpenCV cannot write this video; try .gif or a folder")
        count += 1
        writer.write(np.ascontiguousarray(frame[: size[1], : size[0], ::-1]))
    if writer is not None:
        writer.release()
    return count


def _write_gif(path: Path, frames: Iterator[Image], frames_per_second: float) -> int:
    if not cv2.haveImageWriter(str(path)):
        raise ImageError(f"{path}: this OpenCV ({cv2.__version__}) writes no .gif; 4.12 does")
    animation = cv2.Animation()
    # four channels: the encoder takes no others
    animation.frames = [cv2.cvtColor(frame, cv2.COLOR_RGB2BGRA) for frame in frames]
    durations = np.full(len(animation.frames), round(1000 / frames_per_second), np.int32)
    animation.durations = durations  # type: ignore[assignment]
    if not cv2.imwriteanimation(str(path), animation):
        raise ImageError(f"{path}: cannot be written")
    return len(animation.frames)


def plot_cameras(
    path: Path,
    points: NDArray[np.float32],
    groups: Mapping[str, NDArray[np.float64]],
    length: float,
) -> None:
    """Picture of cameras in a map: positions, viewing directions, and some of its points.

    Args:
        points: [N, 3], scene units.
        groups: T_scene_cam [M, 4, 4] by the legend's name.
        length: of a viewing direction's arrow times four, scene units.

    Raises:
        ImageError: `path` cannot be written.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(9, 8), layout="constrained")
    axes: Any = figure.add_subplot(projection="3d")
    positions = np.concatenate([T[:, :3, 3] for T in groups.values()])
    middle = positions.mean(axis=0)
    reach = 1.3 * max(float(np.abs(positions - middle).max()), length)
    near = points[(np.abs(points - middle) < reach).all(axis=1)]
    shown = near[:: max(1, len(near) // 4000)]
    axes.scatter(*shown.T, s=0.5, color="0.6", alpha=0.5)
    for colour, (name, T) in zip(("tab:red", "tab:blue"), groups.items(), strict=False):
        axes.scatter(*T[:, :3, 3].T, s=14, color=colour, label=name)
        axes.quiver(*T[:, :3, 3].T, *T[:, :3, 2].T, length=length / 4, color=colour, linewidth=0.7)
    axes.set(xlabel="x", ylabel="y", zlabel="z")
    axes.set_aspect("equal")
    axes.legend(loc="upper left")
    try:
        figure.savefig(path, dpi=110)
    except (OSError, ValueError) as error:
        raise ImageError(f"{path}: cannot be written: {error}") from error
    finally:
        plt.close(figure)
