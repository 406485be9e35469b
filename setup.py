"""Build of the native renderer.

The extension module file `igaussian_core/render/_splat*.so` is a plain shared library with a C
interface that ctypes loads: it uses nothing of Python's, so one build serves any interpreter.
The kernel's source is compiled once per instruction set; the choice is made when it runs.
"""

from __future__ import annotations

import platform
from pathlib import Path

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext

NATIVE = "igaussian_core/render/native"
# -ffast-math is out: it may delete the rounding by a magic number, and infinities are tested for
FLAGS = [
    "-std=c++17",
    "-O3",
    "-fPIC",
    "-fvisibility=hidden",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-ffp-contract=fast",
    "-pthread",
    "-Wall",
    "-Wextra",
    "-Wno-psabi",
    "-Wno-maybe-uninitialized",  # false alarms inside GCC's own intrinsics headers
    "-g0",
]
X86_KERNELS = {
    "Avx2": ["-mavx2", "-mfma", "-mf16c", "-mbmi", "-mbmi2", "-mlzcnt", "-mpopcnt"],
    "Avx512": [
        "-mavx512f",
        "-mavx512bw",
        "-mavx512dq",
        "-mavx512vl",
        "-mfma",
        "-mf16c",
        "-mbmi",
        "-mbmi2",
        "-mlzcnt",
        "-mpopcnt",
    ],
}


def is_x86() -> bool:
    return platform.machine().lower() in ("x86_64", "amd64")


def native_extension() -> Extension:
    """The renderer's shared library; every source is listed so that an sdist carries it."""
    native = Path(NATIVE)
    return Extension(
        "igaussian_core.render._splat",
        sources=sorted(str(path) for path in native.glob("*.cpp")),
        depends=sorted(str(path) for path in native.glob("*.h")),
        language="c++",
    )


class BuildNative(build_ext):
    """Compiles kernel.cpp once per instruction set, each with its own flags, and links all."""

    def build_extension(self, ext: Extension) -> None:
        common = [source for source in ext.sources if not source.endswith("kernel.cpp")]
        kernel = f"{NATIVE}/kernel.cpp"
        macros: list[tuple[str, str | None]] = [("IGAUSSIAN_X86", None)] if is_x86() else []
        objects = self._compile(common, FLAGS, macros, "common")
        kernels = {"Portable": [], **(X86_KERNELS if is_x86() else {})}
        for name, flags in kernels.items():
            named = [
                *macros,
                ("IGAUSSIAN_KERNEL", f"k{name}Kernel"),
                ("IGAUSSIAN_KERNEL_NAME", f'"{name.lower()}"'),
            ]
            objects += self._compile([kernel], FLAGS + flags, named, name.lower())
        self.compiler.link_shared_object(
            objects,
            self.get_ext_fullpath(ext.name),
            extra_postargs=["-pthread"],
            target_lang="c++",
        )

    def _compile(
        self,
        sources: list[str],
        flags: list[str],
        macros: list[tuple[str, str | None]],
        folder: str,
    ) -> list[str]:
        return self.compiler.compile(
            sources,
            output_dir=str(Path(self.build_temp) / folder),
            macros=macros,
            extra_postargs=flags,
        )


if __name__ == "__main__":
    setup(
        name="igaussian",
        version="0.1.0",
        packages=find_packages(include=["igaussian_core*", "igaussian_ros*"]),
        ext_modules=[native_extension()],
        cmdclass={"build_ext": BuildNative},
    )
