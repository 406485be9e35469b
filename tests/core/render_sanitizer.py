"""Builds the renderer with the address and undefined-behaviour sanitizers and renders odd scenes.

    python tests/core/render_sanitizer.py [build folder]

Exit status 0: clean; 77: cannot be done here, the reason is printed; anything else: a finding, or
the build failed.
"""

from __future__ import annotations

import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
NATIVE = ROOT / "igaussian_core/render/native"
KERNELS = {
    "Portable": [],
    "Avx2": ["-mavx2", "-mfma", "-mf16c", "-mbmi2"],
    "Avx512": ["-mavx512f", "-mavx512bw", "-mavx512dq", "-mavx512vl", "-mfma", "-mf16c", "-mbmi2"],
}
FLAGS = ["-std=c++17", "-O1", "-g", "-fPIC", "-pthread", "-w"]
FLAGS += ["-fno-math-errno", "-fno-trapping-math"]
# float to int of lanes that are not used is undefined in C++ and harmless
SANITIZE = ["-fsanitize=address,undefined", "-fno-sanitize=float-cast-overflow,shift"]


def build(folder: Path) -> Path:
    x86 = platform.machine() in ("x86_64", "amd64")
    macros = ["-DIGAUSSIAN_X86"] if x86 else []
    jobs = []
    objects = []
    for source in sorted(NATIVE.glob("*.cpp")):
        kernels = (KERNELS if x86 else {"Portable": []}) if source.stem == "kernel" else {"": []}
        for name, flags in kernels.items():
            named = [f"-DIGAUSSIAN_KERNEL=k{name}Kernel"]
            named += [f'-DIGAUSSIAN_KERNEL_NAME="{name.lower()}"']
            target = folder / f"{source.stem}{name}.o"
            objects.append(str(target))
            command = ["g++", *FLAGS, *SANITIZE, *macros, *named, *flags]
            jobs.append(subprocess.Popen([*command, "-c", str(source), "-o", str(target)]))
    if any(job.wait() for job in jobs):
        sys.exit("the instrumented renderer does not compile")
    library = folder / "_splat_sanitized.so"
    subprocess.run(["g++", "-shared", *SANITIZE, *objects, "-o", str(library)], check=True)
    return library


def render_odd_scenes(library: Path) -> None:
    sys.path.insert(0, str(ROOT))
    import numpy as np

    from igaussian_core.camera import Camera
    from igaussian_core.render import Rasterizer, available_simd, native_library

    native_library.library_path = lambda: library
    rng = np.random.default_rng(0)
    frames = 0
    for count in (0, 1, 17, 3000):
        scene = (
            rng.normal(0, 2, (count, 3)),
            rng.normal(size=(count, 4)),
            np.exp(rng.normal(-3, 2, (count, 3))),
            rng.uniform(0, 1, count),
            rng.normal(0, 0.4, (count, 9, 3)),
        )
        for simd in available_simd():
            rasterizer = Rasterizer(*scene, simd=simd)
            for width, height in ((1, 1), (33, 31), (131, 70)):
                camera = Camera(width, height, 40, 40, width / 2, height / 3)
                outputs = ("rgb", "depth", "alpha", "median_depth", "ids")
                for some in (outputs, outputs[1:2]):
                    rasterizer.render(camera, np.eye(4), outputs=some, threads=2)
                    frames += 1
                rasterizer.render_batch(camera, np.tile(np.eye(4), (3, 1, 1)), threads=2)
                by_rgb = rng.normal(size=(height, width, 3))
                rasterizer.gradients(camera, np.eye(4), scene, rgb=by_rgb, threads=2)
    print(f"rendered {frames} frames, nothing found")


def main() -> None:
    if len(sys.argv) == 3:
        render_odd_scenes(Path(sys.argv[2]))
        return
    runtime = subprocess.run(
        ["g++", "-print-file-name=libasan.so"], capture_output=True, text=True
    ).stdout.strip()
    if not os.path.isabs(runtime):
        print("the compiler has no address sanitizer runtime")
        sys.exit(77)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(sys.argv[1] if len(sys.argv) > 1 else temporary)
        library = build(folder)
        environment = os.environ | {
            "LD_PRELOAD": runtime,
            "ASAN_OPTIONS": "detect_leaks=0",
            "UBSAN_OPTIONS": "halt_on_error=1:print_stacktrace=1",
        }
        command = [sys.executable, __file__, "run", str(library)]
        sys.exit(subprocess.run(command, env=environment).returncode)


if __name__ == "__main__":
    main()
