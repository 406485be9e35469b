"""Files of 3D Gaussians: one module a format, told apart by content first and name second.

Each reader turns a file into `RawGaussians` in the frame of the INRIA .ply that it came from;
`docs/map-formats.md` says what each format stores and loses.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

from igaussian_core.errors import MapError
from igaussian_core.formats import nerfstudio, ply, sog, splat, spz
from igaussian_core.formats.raw import RawGaussians

__all__ = ["SUPPORTED", "RawGaussians", "map_file", "read_gaussians"]

SUPPORTED = (
    ".ply (INRIA's layout, SuperSplat compressed), .splat, .spz (versions 1 to 4), "
    ".sog (versions 1 and 2; a folder with meta.json or a zip archive), "
    "folders that INRIA's trainer or nerfstudio's splatfacto wrote"
)


def read_gaussians(path: str | Path) -> RawGaussians:
    """Read a file, or a folder, of any supported format.

    Raises:
        MapError: missing, of no supported format, truncated or damaged.
    """
    file = Path(path)
    try:
        return _read(map_file(file))
    except OSError as error:
        raise MapError(f"{file}: cannot be read: {error.strerror or error}") from error
    except MemoryError as error:
        raise MapError(f"{file}: needs more memory than there is") from error


def map_file(path: str | Path) -> Path:
    """The file that holds a map: the path itself, or the newest one that a trainer left in a
    folder.

    Raises:
        MapError: a folder of no known kind.
    """
    folder = Path(path)
    if not folder.is_dir():
        return folder
    if (folder / "meta.json").is_file():
        return folder / "meta.json"
    for pattern in (
        "point_cloud/iteration_*/point_cloud.ply", "nerfstudio_models/step-*.ckpt",
    ):  # fmt: skip
        found = sorted(folder.glob(pattern), key=_iteration)
        if found:
            return found[-1]
    raise MapError(f"{folder}: a folder without a map; supported: {SUPPORTED}")


def _iteration(file: Path) -> int:
    """The number in iteration_30000/point_cloud.ply or step-000029999.ckpt."""
    text = file.parent.name if file.name == "point_cloud.ply" else file.stem
    digits = "".join(letter for letter in text if letter.isdigit())
    return int(digits or 0)


def _read(file: Path) -> RawGaussians:
    if not file.is_file():
        raise MapError(f"{file}: no such file")
    with open(file, "rb") as stream:
        magic = stream.read(4)
    if magic[:3] == b"ply":
        return ply.read(file)
    if magic == b"NGSP" or magic[:2] == b"\x1f\x8b":
        return spz.read(file)
    if file.suffix.lower() == ".ckpt":
        return nerfstudio.read(file)
    if magic == b"PK\x03\x04" and zipfile.is_zipfile(file):
        return sog.read_archive(file)
    if file.name == "meta.json":
        return sog.read_folder(file.parent)
    if file.suffix.lower() == ".splat":
        return splat.read(file)
    raise MapError(f"{file}: {_what(magic, file.suffix.lower())}; supported: {SUPPORTED}")


def _what(magic: bytes, suffix: str) -> str:
    if not magic:
        return "the file is empty"
    if magic == b"glTF" or suffix in (".gltf", ".ksplat"):
        return f"{suffix or 'glTF'} is not supported (convert it to .ply or .spz)"
    if magic == b"PK\x03\x04":
        return "a damaged zip archive"
    return "not recognised as a file of 3D Gaussians"
