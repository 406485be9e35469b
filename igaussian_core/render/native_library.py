"""The native renderer, loaded with ctypes (which releases the GIL during a call)."""

from __future__ import annotations

import ctypes
import functools
import importlib.machinery
import os
from pathlib import Path

from igaussian_core.errors import IGaussianError

ABI = 2
SIMD = ("avx512", "avx2", "portable")  # best first
SIMD_VARIABLE = "IGAUSSIAN_SIMD"
STATUS_OK = 0

_float_p = ctypes.POINTER(ctypes.c_float)
_int_p = ctypes.POINTER(ctypes.c_int32)


class Gaussians(ctypes.Structure):
    """Mirror of `struct Gaussians` in native/model.h."""

    _fields_ = [
        ("count", ctypes.c_int64),
        ("sh_count", ctypes.c_int),
        ("means", _float_p),
        ("quats_wxyz", _float_p),
        ("scales", _float_p),
        ("opacities", _float_p),
        ("sh", _float_p),
    ]


class Frame(ctypes.Structure):
    """Mirror of `struct Frame` in native/renderer.h."""

    _fields_ = [
        ("width", ctypes.c_int32),
        ("height", ctypes.c_int32),
        ("threads", ctypes.c_int32),
        ("fx", ctypes.c_float),
        ("fy", ctypes.c_float),
        ("cx", ctypes.c_float),
        ("cy", ctypes.c_float),
        ("near_plane", ctypes.c_float),
        ("T_cam_scene", ctypes.c_double * 16),
        ("background", ctypes.c_float * 3),
        ("rgb", _float_p),
        ("depth", _float_p),
        ("alpha", _float_p),
        ("median_depth", _float_p),
        ("ids", _int_p),
        ("nanoseconds", ctypes.c_int64 * 3),
        ("visible", ctypes.c_int64),
        ("entries", ctypes.c_int64),
        ("cells", ctypes.c_int64),
    ]


class Gradients(ctypes.Structure):
    """Mirror of `struct Gradients` in native/gradient.h."""

    _fields_ = [
        ("rgb", _float_p),
        ("depth", _float_p),
        ("alpha", _float_p),
        ("means", _float_p),
        ("quats_wxyz", _float_p),
        ("scales", _float_p),
        ("opacities", _float_p),
        ("sh", _float_p),
        ("T_cam_scene", ctypes.c_double * 16),
    ]


def library_path() -> Path | None:
    """Where the built library lies, next to this file; None where it was never built."""
    folder = Path(__file__).parent
    for suffix in importlib.machinery.EXTENSION_SUFFIXES:
        path = folder / f"_splat{suffix}"
        if path.is_file():
            return path
    return None


@functools.cache
def library() -> ctypes.CDLL:
    """The loaded library.

    Raises:
        IGaussianError: not built, or built from other sources than this package.
    """
    path = library_path()
    if path is None:
        raise IGaussianError(
            f"{Path(__file__).parent}: the native renderer is not built; "
            "run 'python setup.py build_ext --inplace' or install the wheel"
        )
    lib = ctypes.CDLL(str(path))
    if lib.igaussian_abi() != ABI:
        raise IGaussianError(f"{path}: interface {lib.igaussian_abi()}, expected {ABI}; rebuild")
    lib.igaussian_supports.argtypes = [ctypes.c_char_p]
    lib.igaussian_create.argtypes = [ctypes.POINTER(Gaussians), ctypes.c_int, ctypes.c_char_p]
    lib.igaussian_create.restype = ctypes.c_void_p
    lib.igaussian_destroy.argtypes = [ctypes.c_void_p]
    lib.igaussian_destroy.restype = None
    lib.igaussian_render.argtypes = [ctypes.c_void_p, ctypes.POINTER(Frame)]
    lib.igaussian_render_batch.argtypes = [
        ctypes.c_void_p,
        ctypes.POINTER(Frame),
        ctypes.c_int,
        ctypes.c_int,
    ]
    lib.igaussian_backward.argtypes = [
        ctypes.c_void_p,
        ctypes.POINTER(Frame),
        ctypes.POINTER(Gaussians),
        ctypes.POINTER(Gradients),
    ]
    return lib


def available_simd() -> tuple[str, ...]:
    """Instruction sets that this CPU runs, fastest first."""
    lib = library()
    return tuple(name for name in SIMD if lib.igaussian_supports(name.encode()))


def choose_simd(simd: str | None = None) -> str:
    """The given instruction set, else that of IGAUSSIAN_SIMD, else the fastest of this CPU.

    Raises:
        IGaussianError: unknown, or this CPU does not run it.
    """
    available = available_simd()
    wanted = simd or os.environ.get(SIMD_VARIABLE) or available[0]
    if wanted not in available:
        source = "simd" if simd else SIMD_VARIABLE
        raise IGaussianError(
            f"{source}={wanted}: not available; this CPU runs {', '.join(available)}"
        )
    return wanted
