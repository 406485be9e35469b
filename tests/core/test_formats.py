"""Gaussian files of every format: decoded as described, in our frame, or refused in one line."""

from __future__ import annotations

import json
import struct
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import splat_files as files
import torch
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from igaussian_core.camera import Camera
from igaussian_core.errors import MapError
from igaussian_core.formats.spz import _packed_quats
from igaussian_core.gaussian_map import GaussianMap, file_sha256, load_map, save_map
from igaussian_core.render.reference import sh_basis

Writer = Callable[[GaussianMap, Path], None]


def flipped(gmap: GaussianMap, signs: tuple[int, int, int]) -> GaussianMap:
    """The same Gaussians seen in axes of other signs, by matrices and a fit of the harmonics."""
    S = np.diag(signs).astype(float)
    count = gmap.sh.shape[1]
    directions = np.random.default_rng(5).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    here = sh_basis(torch.tensor(directions), count).numpy()
    there = sh_basis(torch.tensor(directions @ S), count).numpy()
    change = np.linalg.lstsq(there, here, rcond=None)[0]
    quats = np.array([quaternion(S @ matrix(q) @ S) for q in gmap.quats_wxyz])
    return GaussianMap(
        (gmap.means @ S).astype(np.float32), quats.astype(np.float32), gmap.scales,
        gmap.opacities, np.einsum("ij,njc->nic", change, gmap.sh).astype(np.float32),
        gmap.antialiased,
    )  # fmt: skip


def matrix(q: np.ndarray) -> np.ndarray:
    w, x, y, z = (float(v) for v in q)
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def quaternion(R: np.ndarray) -> np.ndarray:
    """Unit quaternion wxyz: the eigenvector of the largest eigenvalue (Bar-Itzhack, 2000)."""
    K = np.array([
        [R[0, 0] - R[1, 1] - R[2, 2], 0, 0, 0],
        [R[1, 0] + R[0, 1], R[1, 1] - R[0, 0] - R[2, 2], 0, 0],
        [R[2, 0] + R[0, 2], R[2, 1] + R[1, 2], R[2, 2] - R[0, 0] - R[1, 1], 0],
        [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], np.trace(R)],
    ])  # fmt: skip
    x, y, z, w = np.linalg.eigh(K)[1][:, -1]
    return np.array([w, x, y, z])


def angles_deg(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    cosine = np.abs(np.sum(a.astype(float) * b, axis=1))
    return np.degrees(2 * np.arccos(np.clip(cosine, 0, 1)))


def assert_close(
    got: GaussianMap, expected: GaussianMap, means: float, angle: float, log_scale: float,
    opacity: float, dc: float, rest: float = np.inf,
) -> None:  # fmt: skip
    assert len(got) == len(expected)
    assert got.dropped == 0
    for name in ("means", "quats_wxyz", "scales", "opacities", "sh"):
        assert getattr(got, name).dtype == np.float32, name
    assert np.abs(got.means - expected.means).max() <= means
    assert angles_deg(got.quats_wxyz, expected.quats_wxyz).max() <= angle
    assert np.abs(np.log(got.scales / expected.scales)).max() <= log_scale
    assert np.abs(got.opacities - expected.opacities).max() <= opacity
    assert np.abs(got.sh[:, 0] - expected.sh[:, 0]).max() <= dc
    if rest < np.inf:
        assert got.sh.shape == expected.sh.shape
        if got.sh.shape[1] > 1:
            assert np.abs(got.sh[:, 1:] - expected.sh[:, 1:]).max() <= rest


def test_splat(tmp_path: Path) -> None:
    gmap = files.soft_map(degree=0)
    files.write_splat(gmap, tmp_path / "map.splat")
    got = load_map(tmp_path / "map.splat")
    assert_close(got, gmap, 0, 1.2, 1e-6, 0.5 / 255 + 1e-6, 0.51 / 255 / files.C0, 0)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("colour_ranges", [True, False])
def test_compressed_ply(tmp_path: Path, degree: int, colour_ranges: bool) -> None:
    gmap = files.soft_map(count=600, degree=degree)
    files.write_compressed_ply(gmap, tmp_path / "map.compressed.ply", colour_ranges)
    got = load_map(tmp_path / "map.compressed.ply")
    # half a step of 10 bits over the 6 units and 7 e-folds that the map spans
    step = 0.51 / 1023
    assert_close(got, gmap, 6 * step, 0.25, 7 * step, 0.51 / 255, 0.51 / 255 / files.C0, 1 / 64)


@pytest.mark.parametrize("version", [1, 2, 3, 4])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spz_is_turned_into_the_frame_of_a_ply(tmp_path: Path, version: int, degree: int) -> None:
    gmap = files.soft_map(degree=degree)
    files.write_spz(flipped(gmap, (1, -1, -1)), tmp_path / "map.spz", version, flags=1)
    got = load_map(tmp_path / "map.spz")
    assert got.antialiased
    position = 2e-3 if version == 1 else 0.51 / 4096
    # three bytes of a quaternion leave w inexact where it is small
    angle = 9.0 if version < 3 else 0.3
    assert_close(got, gmap, position, angle, 0.51 / 16, 0.51 / 255, 0.51 / 255 / 0.15, 0.51 / 128)


def test_spz_without_gzip(tmp_path: Path) -> None:
    gmap = files.soft_map(degree=0)
    files.write_spz(gmap, tmp_path / "map.spz", 2, compress=False)
    assert len(load_map(tmp_path / "map.spz")) == len(gmap)


SYSTEMS = {1: (-1, 1, -1), 2: (1, 1, -1), 3: (-1, -1, -1), 4: (1, -1, -1),
           5: (-1, 1, 1), 6: (1, 1, 1), 7: (-1, -1, 1), 8: (1, -1, 1)}  # fmt: skip


@pytest.mark.parametrize("system", SYSTEMS)
@pytest.mark.parametrize("version", [3, 4])
def test_spz_names_its_axes(tmp_path: Path, system: int, version: int) -> None:
    gmap = files.soft_map(count=60, degree=3)
    other = struct.pack("<II5s", 0xADBE0002, 5, b"other")
    extension = other + struct.pack("<III", 0xADBE0003, 4, system)
    file = tmp_path / "map.spz"
    files.write_spz(flipped(gmap, SYSTEMS[system]), file, version, 2, extension)
    assert_close(load_map(file), gmap, 2e-4, 0.3, 0.04, 0.01, 0.02, 0.005)


def test_spz_of_swapped_axes_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "map.spz"
    extension = struct.pack("<III", 0xADBE0003, 4, 12)
    files.write_spz(files.soft_map(count=3), file, 4, 2, extension)
    with pytest.raises(MapError, match="coordinate system 12"):
        load_map(file)


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("archive", [True, False])
def test_sog(tmp_path: Path, version: int, degree: int, archive: bool) -> None:
    gmap = files.soft_map(degree=degree)
    path = write_sog(files.sog_files(gmap, version), tmp_path, archive)
    got = load_map(path)
    opacity = 0.51 / 255 if version == 2 else 0.51 / 255 * 7.8 / 4
    assert_close(got, gmap, 4 * 2.8 / 65535, 0.9, 7.2 * 0.51 / 255, opacity, 3.51 * 0.51 / 255,
                 1.81 * 0.51 / 255)  # fmt: skip
    assert got.file_format == f".sog version {version}"
    if not archive:
        assert np.array_equal(load_map(path / "meta.json").means, got.means)
        assert file_sha256(path) == file_sha256(path / "meta.json")


def write_sog(contents: dict[str, bytes], folder: Path, archive: bool) -> Path:
    if archive:
        with zipfile.ZipFile(folder / "map.sog", "w") as out:
            for name, data in contents.items():
                out.writestr(name, data)
        return folder / "map.sog"
    (folder / "map").mkdir()
    for name, data in contents.items():
        (folder / "map" / name).write_bytes(data)
    return folder / "map"


@pytest.mark.parametrize("degree", [0, 3])
def test_written_spz_is_read_back(tmp_path: Path, degree: int) -> None:
    gmap = files.soft_map(degree=degree, count=500)
    gmap.antialiased = True
    save_map(gmap, tmp_path / "map.spz")
    got = load_map(tmp_path / "map.spz")
    # 24 bits hold +-3 with 20 fractional bits
    assert_close(got, gmap, 2**-20, 0.25, 0.51 / 16, 0.51 / 255, 0.51 / 255 / 0.15, 0.51 / 128)
    assert got.antialiased


def test_written_spz_is_what_the_description_says(tmp_path: Path) -> None:
    gmap = files.soft_map(count=80, degree=1)
    save_map(gmap, tmp_path / "ours.spz")
    files.write_spz(flipped(gmap, (1, -1, -1)), tmp_path / "theirs.spz", 3)
    ours, theirs = load_map(tmp_path / "ours.spz"), load_map(tmp_path / "theirs.spz")
    assert_close(ours, theirs, 2e-4, 0.3, 0.07, 0.005, 0.03, 0.009)


def test_far_gaussians_leave_fewer_fractional_bits(tmp_path: Path) -> None:
    gmap = files.soft_map(count=50, degree=0)
    gmap.means[0] = (0, 60_000, 0)
    save_map(gmap, tmp_path / "map.spz")
    assert np.abs(load_map(tmp_path / "map.spz").means - gmap.means).max() <= 2**-7
    gmap.means[0] = (0, 1e8, 0)
    with pytest.raises(MapError, match="coordinates up to"):
        save_map(gmap, tmp_path / "far.spz")


def test_empty_and_degenerate_maps_are_written(tmp_path: Path) -> None:
    gmap = files.soft_map(count=4, degree=1)
    gmap.scales[0] = (0, 1e-20, 1e6)
    save_map(gmap, tmp_path / "map.spz")
    low, low_too, high = load_map(tmp_path / "map.spz").scales[0]
    assert low == low_too == pytest.approx(np.exp(-10), rel=1e-5)
    assert high == pytest.approx(np.exp(255 / 16 - 10), rel=1e-5)
    for name in ("empty.spz", "empty.ply"):
        save_map(gmap.subset(np.zeros(4, bool)), tmp_path / name)
        assert len(load_map(tmp_path / name)) == 0


def test_only_known_suffixes_are_written(tmp_path: Path) -> None:
    with pytest.raises(MapError, match=r"\.ply, \.spz"):
        save_map(files.soft_map(2), tmp_path / "map.splat")
    with pytest.raises(MapError, match="cannot be written"):
        save_map(files.soft_map(2), tmp_path / "no folder" / "map.spz")


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4))
def test_packed_quaternions_keep_the_rotation(values: list[float]) -> None:
    quat = np.array(values)
    if np.linalg.norm(quat) < 1e-3:
        return
    quat = (quat / np.linalg.norm(quat))[None].astype(np.float32)
    packed = int(_packed_quats(quat)[0])
    xyzw = [0.0] * 4
    places = [i for i in range(4) if i != packed >> 30]
    for place, shift in zip(places, (20, 10, 0), strict=True):
        field = packed >> shift & 1023
        xyzw[place] = (-1 if field >> 9 else 1) * (field & 511) / 511 / 2**0.5
    xyzw[packed >> 30] = max(0.0, 1 - sum(v * v for v in xyzw)) ** 0.5
    assert angles_deg(np.array([[xyzw[3], *xyzw[:3]]]), quat)[0] < 0.3


WRITERS: dict[str, Writer] = {
    "map.splat": files.write_splat,
    "map.compressed.ply": files.write_compressed_ply,
    "v1.spz": lambda g, f: files.write_spz(g, f, 1),
    "v2.spz": lambda g, f: files.write_spz(g, f, 2),
    "raw.spz": lambda g, f: files.write_spz(g, f, 3, compress=False),
    "v3.spz": lambda g, f: files.write_spz(g, f, 3),
    "v4.spz": lambda g, f: files.write_spz(g, f, 4),
    "map.sog": lambda g, f: write_sog(files.sog_files(g), f.parent, True).rename(f) and None,
}


@pytest.fixture(scope="module")
def samples(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """One small valid file of each format."""
    folder, gmap = tmp_path_factory.mktemp("samples"), files.soft_map(count=40, degree=1)
    for name, write in WRITERS.items():
        write(gmap, folder / name)
    return {name: (folder / name).read_bytes() for name in WRITERS}


@pytest.mark.parametrize("name", WRITERS)
def test_content_decides_not_the_name(
    tmp_path: Path, samples: dict[str, bytes], name: str
) -> None:
    other = "map.splat" if name == "map.splat" else "map.bin"
    (tmp_path / other).write_bytes(samples[name])
    assert len(load_map(tmp_path / other)) == 40


@pytest.mark.parametrize("name", WRITERS)
def test_every_truncation_is_refused(
    tmp_path: Path, samples: dict[str, bytes], name: str
) -> None:
    data, file = samples[name], tmp_path / name
    lengths = {*range(0, 64), *np.linspace(64, len(data) - 1, 60).astype(int).tolist()}
    for length in sorted(lengths):
        if name == "map.splat" and length % 32 == 0 and length:
            continue  # still a whole number of records
        file.write_bytes(data[:length])
        with pytest.raises(MapError, match=name):
            load_map(file)


@pytest.mark.parametrize("name", WRITERS)
def test_altered_bytes_are_refused_or_give_a_finite_map(
    tmp_path: Path, samples: dict[str, bytes], name: str
) -> None:
    rng = np.random.default_rng(3)
    file, refused = tmp_path / name, 0
    for trial in range(120):
        data = bytearray(samples[name])
        # the first bytes are the ones that steer a reader
        where = rng.integers(0, min(len(data), 64 if trial % 2 else len(data)), 3)
        for i in where:
            data[i] = rng.integers(256)
        file.write_bytes(data)
        try:
            gmap = load_map(file)
        except MapError as error:
            refused += 1
            assert str(file) in str(error)
            continue
        for array in (gmap.means, gmap.quats_wxyz, gmap.scales, gmap.opacities, gmap.sh):
            assert np.isfinite(array).all()
        assert (gmap.scales >= 0).all()
        assert ((gmap.opacities >= 0) & (gmap.opacities <= 1)).all()
    if name not in ("map.splat",):  # which has nothing to check but numbers
        assert refused


@given(st.binary(min_size=0, max_size=400))
def test_any_bytes_are_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, data: bytes
) -> None:
    for prefix in (b"ply\n", b"NGSP", b"\x1f\x8b", b"PK\x03\x04", b""):
        file = tmp_path_factory.getbasetemp() / "any.bin"
        file.write_bytes(prefix + data)
        with pytest.raises(MapError) as caught:
            load_map(file)
        assert "\n" not in str(caught.value)


def declared_counts() -> dict[str, bytes]:
    """Files of a few bytes that declare billions of Gaussians."""
    import gzip

    many = 4_000_000_000
    legacy = struct.pack("<4sIIBBBB", b"NGSP", 3, many, 3, 12, 0, 0)
    bomb = zstandard.compress(bytes(1 << 20))
    new = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, many, 0, 12, 0, 5, 32)
    sizes = [many * n for n in (9, 1, 3, 3, 4)]
    table = b"".join(struct.pack("<QQ", len(bomb), size) for size in sizes)
    names = [*"xyz", *(f"f_dc_{i}" for i in range(3)), "opacity"]
    names += [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
    properties = "\n".join(f"property float {name}" for name in names)
    texts = {
        f"{kind}.ply": f"ply\nformat {kind} 1.0\nelement vertex {many * 100}\n{properties}\n"
                       "end_header\n0 0 0 0\n".encode()
        for kind in ("ascii", "binary_little_endian", "binary_big_endian")
    }  # fmt: skip
    lists = (f"ply\nformat ascii 1.0\nelement face {many * 100}\nproperty list uchar int v\n"
             f"element vertex 1\n{properties}\nend_header\n").encode()  # fmt: skip
    return texts | {
        "lists.ply": lists,
        "legacy.spz": gzip.compress(legacy),
        "raw.spz": legacy,
        "new.spz": new + table + bomb * 5,
    }


@pytest.mark.parametrize("name", declared_counts())
def test_huge_declared_counts_allocate_little(tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    file.write_bytes(declared_counts()[name])
    tracemalloc.start()
    try:
        with pytest.raises(MapError, match=name):
            load_map(file)
        assert tracemalloc.get_traced_memory()[1] < 30e6
    finally:
        tracemalloc.stop()


def test_zstd_stream_that_unpacks_to_more_is_cut(tmp_path: Path) -> None:
    """A stream's own idea of its size is not followed beyond what the header asks for."""
    file = tmp_path / "map.spz"
    files.write_spz(files.soft_map(count=5, degree=0), file, 4)
    data = bytearray(file.read_bytes())
    bomb = zstandard.compress(bytes(200_000_000))
    struct.pack_into("<Q", data, 32, len(bomb))
    first = struct.unpack_from("<Q", file.read_bytes(), 32)[0]
    start = 32 + 5 * 16
    file.write_bytes(bytes(data[:start]) + bomb + bytes(data[start + first :]))
    tracemalloc.start()
    assert len(load_map(file)) == 5
    assert tracemalloc.get_traced_memory()[1] < 30e6
    tracemalloc.stop()


def changed_sog(tmp_path: Path, change: Callable[[dict], None]) -> Path:
    contents = files.sog_files(files.soft_map(count=40, degree=1))
    meta = json.loads(contents["meta.json"])
    change(meta)
    contents["meta.json"] = json.dumps(meta).encode()
    return write_sog(contents, tmp_path, archive=False)


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (lambda m: m.update(count=10**12), "declares"),
        (lambda m: m.update(count=-1), "declares"),
        (lambda m: m.update(count=500), "pixels for 500"),
        (lambda m: m.update(version=3), "version 3"),
        (lambda m: m.pop("quats"), "quats"),
        (lambda m: m["quats"].update(files=["absent.webp"]), "absent.webp is missing"),
        (lambda m: m["quats"].update(files=["../meta.json"]), "outside"),
        (lambda m: m["quats"].update(files=["meta.json"]), "no WebP"),
        (lambda m: m["scales"].update(codebook=[1.0, 2.0]), "codebook of 2"),
        (lambda m: m["means"].update(mins=[0.0]), "mins"),
        (lambda m: m["means"].update(mins="abc"), "damaged"),
        (lambda m: m["shN"].update(bands=2), "palette"),
        (lambda m: m["shN"].update(bands=7), "palette"),
    ],
)
def test_sog_that_does_not_fit_together(
    tmp_path: Path, change: Callable[[dict], None], cause: str
) -> None:
    with pytest.raises(MapError, match=cause) as caught:
        load_map(changed_sog(tmp_path, change))
    assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize("data", [b"{", b"[]", b"12", b"null", b'{"version": 2}', b"\xff\xfe"])
def test_meta_that_is_no_description(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "meta.json").write_bytes(data)
    with pytest.raises(MapError, match="meta.json"):
        load_map(tmp_path)


def test_lossy_images_are_refused(tmp_path: Path) -> None:
    import cv2

    folder = write_sog(files.sog_files(files.soft_map(count=40)), tmp_path, archive=False)
    _, lossy = cv2.imencode(".webp", np.zeros((20, 20, 3), np.uint8),
                            [cv2.IMWRITE_WEBP_QUALITY, 80])  # fmt: skip
    (folder / "scales.webp").write_bytes(lossy.tobytes())
    with pytest.raises(MapError, match="lossy"):
        load_map(folder)


def test_giant_image_is_refused_unpacked(tmp_path: Path) -> None:
    folder = write_sog(files.sog_files(files.soft_map(count=40)), tmp_path, archive=False)
    data = bytearray((folder / "quats.webp").read_bytes())
    data[21:25] = (16383 | 16383 << 14).to_bytes(4, "little")
    (folder / "quats.webp").write_bytes(data)
    with pytest.raises(MapError, match="16384x16384"):
        load_map(folder)


def test_zip_archives_of_other_things(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "photos.zip", "w") as out:
        out.writestr("photo.jpg", b"abc")
    with pytest.raises(MapError, match="without meta.json"):
        load_map(tmp_path / "photos.zip")


@pytest.mark.parametrize(
    ("name", "data", "cause"),
    [
        ("scene.glb", b"glTF\x02\0\0\0" + bytes(40), "glb is not supported"),
        ("scene.gltf", b'{"asset": {}}', "gltf is not supported"),
        ("scene.ksplat", bytes(4096), "ksplat is not supported"),
        ("scene.bin", b"abcdefgh", "not recognised"),
        ("scene.ply", b"", "empty"),
    ],
)
def test_what_is_not_supported_is_named(
    tmp_path: Path, name: str, data: bytes, cause: str
) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(MapError, match=cause) as caught:
        load_map(tmp_path / name)
    assert "supported: .ply" in str(caught.value)


def test_folders_that_are_no_map(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="without a map"):
        load_map(tmp_path)
    with pytest.raises(MapError, match="no such file"):
        load_map(tmp_path / "absent.spz")


def test_damaged_splat_records_are_left_out(tmp_path: Path) -> None:
    gmap = files.soft_map(count=30, degree=0)
    files.write_splat(gmap, tmp_path / "map.splat")
    data = bytearray((tmp_path / "map.splat").read_bytes())
    struct.pack_into("<f", data, 12, -1.0)  # a negative scale
    struct.pack_into("<f", data, 32, float("nan"))
    data[64 + 28 : 64 + 32] = bytes([128] * 4)  # no rotation
    (tmp_path / "map.splat").write_bytes(data)
    got = load_map(tmp_path / "map.splat")
    assert got.dropped == 3
    assert np.array_equal(got.means, gmap.means[3:])


@pytest.fixture
def splats(data_dir: Path) -> Path:
    folder = data_dir / "splats"
    if not folder.is_dir():
        pytest.skip(f"no corpus of Gaussian files in {data_dir}")
    return folder


CORPUS = {  # name: count, SH degree
    "trained_inria_sh3_9080.ply": (9080, 3), "trained_22764.splat": (22764, 0),
    "biker.compressed.ply": (152746, 0), "playbot_lod2_sog": (125000, 2),
    "minimal/minimal-raw.spz": (4, 0), "minimal/minimal-v2.spz": (4, 0),
    "minimal/minimal-v3.spz": (4, 0), "minimal/minimal-v4.spz": (4, 0),
    "minimal/minimal.splat": (4, 0),
}  # fmt: skip


@pytest.mark.parametrize("name", CORPUS)
def test_corpus_renders(splats: Path, name: str) -> None:
    from igaussian_core.geometry import inverse
    from igaussian_core.overview import overview

    gmap = load_map(splats / name)
    assert (len(gmap), gmap.sh_degree) == CORPUS[name]
    view = overview(gmap, 160, 120)
    rgb, depth, alpha = gmap.render(view.camera, inverse(view.T_scene_cam))
    assert np.isfinite(rgb).all() and np.isfinite(depth).all()
    assert alpha.max() > 0.5
    assert rgb.std() > 0.01


def test_minimal_files_of_all_formats_agree(splats: Path) -> None:
    """Converted from one .ply by the tool that writes them all in one frame."""
    splat = load_map(splats / "minimal" / "minimal.splat")
    for name in ("minimal-v3.spz", "minimal-v4.spz"):
        spz = load_map(splats / "minimal" / name)
        order = [int(np.linalg.norm(spz.means - m, axis=1).argmin()) for m in splat.means]
        assert sorted(order) == [0, 1, 2, 3], name
        assert np.allclose(spz.means[order], splat.means, atol=1e-3)
        assert np.allclose(spz.scales[order], splat.scales, rtol=0.04)
        assert np.allclose(spz.opacities[order], splat.opacities, atol=0.01)


def test_real_map_survives_spz(splats: Path, tmp_path: Path) -> None:
    """A trained map looks the same after the compact form, which is a tenth of its size."""
    source = splats / "trained_inria_sh3_9080.ply"
    gmap = load_map(source)
    save_map(gmap, tmp_path / "map.spz")
    assert (tmp_path / "map.spz").stat().st_size < 0.25 * source.stat().st_size
    camera = Camera(320, 240, 250, 250, 159.5, 119.5)
    a, _, _ = gmap.render(camera, np.eye(4))
    b, _, _ = load_map(tmp_path / "map.spz").render(camera, np.eye(4))
    assert -10 * np.log10(np.mean((a - b) ** 2)) > 40


def test_zip_of_an_unknown_version(tmp_path: Path) -> None:
    path = write_sog(files.sog_files(files.soft_map(count=40)), tmp_path, archive=True)
    data = bytearray(path.read_bytes())
    data[data.index(b"PK\x01\x02") + 6] = 200
    path.write_bytes(data)
    with pytest.raises(MapError, match="damaged zip archive"):
        load_map(path)
