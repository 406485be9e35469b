"""Builds the renderer for aarch64, runs it under an emulator and compares with this machine's.

    apt-get install g++-aarch64-linux-gnu qemu-user
    python tests/core/render_cross_check.py

Exit status 77, with the reason, where compiler or emulator is missing.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

from igaussian_core.camera import Camera  # noqa: E402
from igaussian_core.render import Rasterizer  # noqa: E402

NATIVE = ROOT / "igaussian_core/render/native"
COMPILER = "aarch64-linux-gnu-g++"
EMULATOR = "qemu-aarch64"
FLAGS = ["-std=c++17", "-O3", "-fno-math-errno", "-fno-trapping-math", "-pthread", "-static", "-w"]
KERNEL = ["-DIGAUSSIAN_KERNEL=kPortableKernel", '-DIGAUSSIAN_KERNEL_NAME="portable"']
WIDTH, HEIGHT = 131, 97


def scene() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    count = 2000
    arrays = (
        rng.uniform(-2, 2, (count, 3)) + [0, 0, 3],
        rng.normal(size=(count, 4)),
        np.exp(rng.normal(-3, 1, (count, 3))),
        rng.uniform(0, 1, count),
        rng.normal(size=(count, 16, 3)) * 0.3,
    )
    return [a.astype(np.float32) for a in arrays]


def main() -> None:
    for tool in (COMPILER, EMULATOR):
        if shutil.which(tool) is None:
            print(f"{tool} is not installed")
            sys.exit(77)
    arrays = scene()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        program, scene_file, result = folder / "program", folder / "scene", folder / "pixels"
        sources = [str(Path(__file__).with_name("render_cross_main.cpp"))]
        sources += [str(path) for path in sorted(NATIVE.glob("*.cpp"))]
        command = [COMPILER, *FLAGS, *KERNEL, "-I", str(NATIVE), *sources, "-o", str(program)]
        subprocess.run(command, check=True)
        head = np.array([len(arrays[0]), 16, WIDTH, HEIGHT], np.int32)
        scene_file.write_bytes(head.tobytes() + b"".join(a.tobytes() for a in arrays))
        subprocess.run([EMULATOR, str(program), str(scene_file), str(result)], check=True)
        foreign = np.fromfile(result, np.float32)
    camera = Camera(WIDTH, HEIGHT, 90, 90, WIDTH / 2, HEIGHT / 2)
    here = Rasterizer(*arrays, simd="portable").render(camera, np.eye(4))
    pixels = WIDTH * HEIGHT
    pairs = (
        ("rgb", foreign[: 3 * pixels].reshape(HEIGHT, WIDTH, 3), here.rgb),
        ("depth", foreign[3 * pixels : 4 * pixels].reshape(HEIGHT, WIDTH), here.depth),
        ("alpha", foreign[4 * pixels :].reshape(HEIGHT, WIDTH), here.alpha),
    )
    for name, theirs, ours in pairs:
        error = np.abs(theirs - ours)
        print(f"{name}: mean {ours.mean():.3f}, 99.9 % of differences under "
              f"{np.quantile(error, 0.999):.1e}, largest {error.max():.1e}")  # fmt: skip
        if not np.quantile(error, 0.999) < 1e-3:
            sys.exit(f"{name} differs")


if __name__ == "__main__":
    main()
