"""Files of 3D Gaussians: one module a format, told apart by content first and name second.

Each reader turns a file into `RawGaussians` in the frame of the INRIA .ply that it came from;
`docs/map-formats.md` says what each format stores and loses.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

from igaussian_core.errors import MapError
from igaussian_core.formats import ply, sog, splat, spz
from igaussian_core.formats.raw import RawGaussians

__all__ = ["SUPPORTED", "RawGaussians", "read_gaussians"]

SUPPORTED = (
    ".ply (INRIA's layout, SuperSplat compressed), .splat, .spz (versions 1 to 4), "
    ".sog (versions 1 and 2; a folder with meta.json or a zip archive)"
)


def read_gaussians(path: str | Path) -> RawGaussians:
    """Read a file, or a .sog folder, of any supported format.

    Raises:
        MapError: missing, of no supported format, truncated or damaged.
    """
    file = Path(path)
    try:
        return _read(file)
    except OSError as error:
        raise MapError(f"{file}: cannot be read: {error.strerror or error}") from error
    except MemoryError as error:
        raise MapError(f"{file}: needs more memory than there is") from error


def _read(file: Path) -> RawGaussians:
    if file.is_dir():
        if (file / "meta.json").is_file():
            return sog.read_folder(file)
        raise MapError(f"{file}: a folder without meta.json; supported: {SUPPORTED}")
    if not file.is_file():
        raise MapError(f"{file}: no such file")
    with open(file, "rb") as stream:
        magic = stream.read(4)
    if magic[:3] == b"ply":
        return ply.read(file)
    if magic == b"NGSP" or magic[:2] == b"\x1f\x8b":
        return spz.read(file)
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
