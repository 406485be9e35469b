"""Gaussian .ply files of every layout that is read, and of many that must be refused."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
import pytest

from igaussian_core.camera import Camera
from igaussian_core.errors import CameraError, MapError
from igaussian_core.gaussian_map import GaussianMap, file_sha256, load_map, save_ply

COEFFICIENTS = {0: 1, 1: 4, 2: 9, 3: 16}


def some_map(
    count: int = 50, degree: int = 1, seed: int = 0, antialiased: bool = False
) -> GaussianMap:
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    return GaussianMap(
        rng.normal(size=(count, 3)).astype(np.float32),
        quats.astype(np.float32),
        np.exp(rng.normal(-3, 1, (count, 3))).astype(np.float32),
        rng.uniform(0.02, 0.98, count).astype(np.float32),
        rng.normal(size=(count, COEFFICIENTS[degree], 3)).astype(np.float32),
        antialiased,
    )


def assert_same(a: GaussianMap, b: GaussianMap, tolerance: float = 1e-5) -> None:
    for name in ("means", "quats_wxyz", "scales", "opacities", "sh"):
        x, y = getattr(a, name), getattr(b, name)
        assert x.shape == y.shape, name
        assert x.dtype == np.float32, name
        assert np.allclose(x, y, rtol=tolerance, atol=tolerance), name
    assert a.antialiased == b.antialiased


def raw_columns(gmap: GaussianMap) -> dict[str, np.ndarray]:
    """INRIA's properties of a map, written from the format's description."""
    p = gmap.opacities.astype(np.float64)
    columns = {axis: gmap.means[:, i] for i, axis in enumerate("xyz")}
    columns |= {f"n{axis}": np.zeros(len(gmap)) for axis in "xyz"}
    columns |= {f"f_dc_{c}": gmap.sh[:, 0, c] for c in range(3)}
    higher = gmap.sh.shape[1] - 1
    for c in range(3):  # all of red, then all of green, then all of blue
        columns |= {f"f_rest_{c * higher + k}": gmap.sh[:, 1 + k, c] for k in range(higher)}
    columns["opacity"] = np.log(p / (1 - p))
    columns |= {f"scale_{i}": np.log(gmap.scales[:, i]) for i in range(3)}
    columns |= {f"rot_{i}": gmap.quats_wxyz[:, i] for i in range(4)}
    return columns


def write(
    path: Path, columns: dict[str, Any], kind: str = "<f4", text: bool = False, order: str = "<",
    comments: tuple[str, ...] = (), element: str = "vertex",
) -> Path:  # fmt: skip
    count = len(next(iter(columns.values())))
    data = np.empty(count, dtype=[(name, kind) for name in columns])
    for name, values in columns.items():
        data[name] = values
    plyfile.PlyData(
        [plyfile.PlyElement.describe(data, element)], text=text, byte_order=order,
        comments=list(comments),
    ).write(str(path))  # fmt: skip
    return path


@pytest.mark.parametrize("degree", COEFFICIENTS)
@pytest.mark.parametrize("antialiased", [False, True])
def test_save_and_load(tmp_path: Path, degree: int, antialiased: bool) -> None:
    gmap = some_map(degree=degree, antialiased=antialiased)
    save_ply(gmap, tmp_path / "map.ply")
    back = load_map(tmp_path / "map.ply")
    assert_same(back, gmap)
    assert back.sh_degree == degree and back.dropped == 0 and len(back) == 50


@pytest.mark.parametrize("degree", COEFFICIENTS)
@pytest.mark.parametrize(
    ("kind", "text", "order"),
    [
        ("f4", False, "<"),
        ("f4", False, ">"),
        ("f8", False, "<"),
        ("f8", False, ">"),
        ("f4", True, "="),
    ],
    ids=["binary", "big endian", "double", "big endian double", "ascii"],
)
def test_layouts_of_other_tools(
    tmp_path: Path, degree: int, kind: str, text: bool, order: str
) -> None:
    gmap = some_map(degree=degree)
    dtype = kind if text else order + kind
    file = write(tmp_path / "map.ply", raw_columns(gmap), dtype, text, order)
    assert_same(load_map(file), gmap)


def test_order_of_properties_does_not_matter(tmp_path: Path) -> None:
    gmap = some_map(degree=3)
    columns = raw_columns(gmap)
    names = list(np.random.default_rng(1).permutation(list(columns)))
    file = write(
        tmp_path / "map.ply", {n: columns[n] for n in names} | {"semantic": gmap.means[:, 0]}
    )
    assert_same(load_map(file), gmap)


def test_colour_channels_are_not_mixed(tmp_path: Path) -> None:
    """f_rest counts channel by channel: a one-coefficient map tells which is which."""
    gmap = some_map(1, degree=2)
    gmap.sh[:] = 0
    columns = raw_columns(gmap)
    columns["f_rest_8"] = np.array([0.5])  # 8 a channel: the first of green
    sh = load_map(write(tmp_path / "map.ply", columns)).sh
    assert sh[0, 1, 1] == 0.5 and np.count_nonzero(sh) == 1


def test_values_are_activated(tmp_path: Path) -> None:
    columns = raw_columns(some_map(1, degree=0))
    columns["opacity"] = np.array([0.0])
    columns["scale_1"] = np.array([np.log(0.25)])
    columns |= {f"rot_{i}": np.array([v]) for i, v in enumerate([0.0, 0.0, -3.0, 0.0])}
    gmap = load_map(write(tmp_path / "map.ply", columns))
    assert gmap.opacities[0] == pytest.approx(0.5)
    assert gmap.scales[0, 1] == pytest.approx(0.25)
    assert gmap.quats_wxyz[0].tolist() == [0, 0, -1, 0]


def test_filter_3d_widens_and_thins(tmp_path: Path) -> None:
    gmap = some_map(5, degree=0)
    columns = raw_columns(gmap) | {"filter_3D": np.full(5, 0.3)}
    wide = load_map(write(tmp_path / "map.ply", columns))
    scales = np.sqrt(gmap.scales**2 + 0.09)
    assert np.allclose(wide.scales, scales, rtol=1e-5)
    thin = gmap.opacities * np.sqrt(np.prod(gmap.scales**2, 1) / np.prod(scales**2, 1))
    assert np.allclose(wide.opacities, thin, rtol=1e-5)


def test_antialiasing_is_read_from_the_comment(tmp_path: Path) -> None:
    columns = raw_columns(some_map(2))
    mip = write(tmp_path / "a.ply", columns, comments=("SplatRenderMode: mip",))
    other = write(tmp_path / "b.ply", columns, comments=("SplatRenderMode: default",))
    assert load_map(mip).antialiased and not load_map(other).antialiased


@pytest.mark.parametrize(
    ("column", "value"),
    [("x", np.nan), ("y", np.inf), ("opacity", np.nan), ("scale_0", np.nan), ("scale_2", 500.0),
     ("f_dc_1", -np.inf), ("f_rest_4", np.nan), ("rot_0", np.nan)],
)  # fmt: skip
def test_gaussians_that_are_not_finite_are_left_out_and_counted(
    tmp_path: Path, column: str, value: float, caplog: pytest.LogCaptureFixture
) -> None:
    gmap = some_map()
    columns = {name: np.array(v, np.float64) for name, v in raw_columns(gmap).items()}
    columns[column][[3, 17]] = value
    file = write(tmp_path / "map.ply", columns)
    with caplog.at_level(logging.WARNING):
        loaded = load_map(file)
    assert (len(loaded), loaded.dropped) == (48, 2)
    assert "2 of 50" in caplog.text and str(file) in caplog.text
    keep = np.delete(np.arange(50), [3, 17])
    assert np.allclose(loaded.means, gmap.means[keep])
    loaded.rasterizer()  # which takes finite values only


def test_zero_quaternions_are_left_out(tmp_path: Path) -> None:
    columns = {name: np.array(v, np.float64) for name, v in raw_columns(some_map()).items()}
    for i in range(4):
        columns[f"rot_{i}"][:5] = 0
        columns[f"rot_{i}"][5:] *= 1e3
    loaded = load_map(write(tmp_path / "map.ply", columns))
    assert loaded.dropped == 5
    assert np.allclose(np.linalg.norm(loaded.quats_wxyz, axis=1), 1, atol=1e-6)


def test_a_mostly_damaged_map_is_refused(tmp_path: Path) -> None:
    columns = {name: np.array(v, np.float64) for name, v in raw_columns(some_map()).items()}
    columns["x"][:26] = np.nan
    with pytest.raises(MapError, match="26 of 50"):
        load_map(write(tmp_path / "map.ply", columns))


def test_opaque_and_tiny_gaussians_survive_a_round_trip(tmp_path: Path) -> None:
    gmap = some_map(3)
    gmap.opacities[:] = [0, 1, 0.5]
    gmap.scales[0] = 0
    save_ply(gmap, tmp_path / "map.ply")
    back = load_map(tmp_path / "map.ply")
    assert np.allclose(back.opacities, [0, 1, 0.5], atol=1e-6) and back.dropped == 0
    assert back.scales[0].max() < 1e-20


def test_an_empty_map_is_a_map_without_bounds(tmp_path: Path) -> None:
    gmap = load_map(write(tmp_path / "map.ply", raw_columns(some_map(0))))
    assert len(gmap) == 0 and gmap.dropped == 0
    with pytest.raises(MapError, match="no Gaussian"):
        gmap.bounds()
    rgb, _, alpha = gmap.render(Camera(8, 6, 5.0, 5.0, 3.5, 2.5), np.eye(4), (1.0, 0.5, 0.0))
    assert alpha.max() == 0 and np.allclose(rgb, [1, 0.5, 0])


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="absent.ply: no such file"):
        load_map(tmp_path / "absent.ply")
    with pytest.raises(MapError):
        load_map(tmp_path)


@pytest.mark.parametrize("missing", ["opacity", "scale_1", "rot_3", "f_dc_0", "z"])
def test_a_missing_property_is_named(tmp_path: Path, missing: str) -> None:
    columns = raw_columns(some_map())
    del columns[missing]
    with pytest.raises(MapError, match=missing):
        load_map(write(tmp_path / "map.ply", columns))


def test_a_plain_point_cloud_is_told_apart(tmp_path: Path) -> None:
    points = {axis: np.zeros(3) for axis in "xyz"} | {
        c: np.zeros(3) for c in ("red", "green", "blue")
    }
    with pytest.raises(MapError, match="point cloud"):
        load_map(write(tmp_path / "cloud.ply", points))


def test_another_element_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MapError, match="vertex"):
        load_map(write(tmp_path / "map.ply", raw_columns(some_map()), element="face"))


@pytest.mark.parametrize("count", [1, 3, 8, 10, 44, 46, 72])
def test_a_wrong_number_of_coefficients_is_refused(tmp_path: Path, count: int) -> None:
    columns = raw_columns(some_map(degree=0)) | {f"f_rest_{i}": np.zeros(50) for i in range(count)}
    with pytest.raises(MapError, match=f"{count} f_rest"):
        load_map(write(tmp_path / "map.ply", columns))


def test_a_gap_in_the_coefficients_is_refused(tmp_path: Path) -> None:
    columns = raw_columns(some_map(degree=1))
    columns["f_rest_20"] = columns.pop("f_rest_8")
    with pytest.raises(MapError, match="f_rest"):
        load_map(write(tmp_path / "map.ply", columns))


def test_every_truncation_is_refused(tmp_path: Path) -> None:
    """Cut anywhere, in the header or the payload: MapError, never another exception."""
    whole = write(tmp_path / "map.ply", raw_columns(some_map(20, degree=0))).read_bytes()
    header = whole.index(b"end_header\n") + len(b"end_header\n")
    cut = tmp_path / "cut.ply"
    for length in [
        *range(0, header, 7),
        header - 1,
        header,
        header + 1,
        len(whole) // 2,
        len(whole) - 1,
    ]:
        cut.write_bytes(whole[:length])
        with pytest.raises(MapError, match="cut.ply"):
            load_map(cut)


NO_PLYS = [
    b"\x89PNG\r\n\x1a\n" + bytes(64),
    b"hello",
    b"ply\n",
    bytes(range(256)) * 4,
    b"ply\nformat binary_little_endian 1.0\nelement vertex -5\nproperty float x\nend_header\n",
    b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar float x\nend_header\n1 2\n",
    b"ply\nformat ascii 1.0\nelement vertex one\nend_header\n",
    b"ply\nformat odd 1.0\nend_header\n",
]


@pytest.mark.parametrize("content", NO_PLYS)
def test_files_that_are_no_ply_are_refused(tmp_path: Path, content: bytes) -> None:
    file = tmp_path / "map.ply"
    file.write_bytes(content)
    with pytest.raises(MapError, match=r"map\.ply"):
        load_map(file)


def test_list_properties_are_refused(tmp_path: Path) -> None:
    columns = raw_columns(some_map(2, degree=0))
    kinds = {"opacity": "list uchar float"}
    header = "\n".join(f"property {kinds.get(n, 'float')} {n}" for n in columns)
    row = " ".join("1 0.5" if n == "opacity" else "0.1" for n in columns)
    file = tmp_path / "map.ply"
    lines = ["ply", "format ascii 1.0", "element vertex 2", header, "end_header", row, row, ""]
    file.write_text("\n".join(lines))
    with pytest.raises(MapError, match=r"map\.ply"):
        load_map(file)


def test_text_among_numbers_is_refused(tmp_path: Path) -> None:
    file = write(tmp_path / "map.ply", raw_columns(some_map(3, degree=0)), text=True)
    lines = file.read_text().splitlines()
    lines[-1] = lines[-1].replace(lines[-1].split()[0], "abc", 1)
    file.write_text("\n".join(lines) + "\n")
    with pytest.raises(MapError, match=r"map\.ply"):
        load_map(file)


def test_bounds_leave_floaters_out() -> None:
    gmap = some_map(2000)
    gmap.means[:] = np.random.default_rng(0).uniform(-1, 1, gmap.means.shape)
    gmap.means[0] = 1000
    gmap.opacities[:] = 0.5
    gmap.opacities[1:800] = 0.01  # too faint to be seen
    gmap.means[1:800] += 50
    low, high = gmap.bounds()
    assert np.allclose(low, -0.98, atol=0.03) and np.allclose(high, 0.98, atol=0.03)


def test_render_is_one_gaussian_at_a_known_place() -> None:
    gmap = some_map(1, degree=0)
    gmap.means[:] = [[0.2, -0.1, 2.0]]
    gmap.scales[:], gmap.opacities[:], gmap.sh[:] = 0.02, 0.9, 1.0
    camera = Camera(101, 81, 100.0, 100.0, 50.0, 40.0)
    rgb, depth, alpha = gmap.render(camera, np.eye(4))
    v, u = np.unravel_index(alpha.argmax(), alpha.shape)
    assert (u, v) == (60, 35)
    assert depth[v, u] == pytest.approx(2.0, rel=1e-4)
    assert rgb.shape == (81, 101, 3) and rgb.dtype == np.float32
    with pytest.raises(CameraError, match="undistorted"):
        gmap.render(Camera(9, 9, 9.0, 9.0, 4.0, 4.0, "plumb_bob", (0.1, 0.0, 0.0, 0.0)), np.eye(4))


def test_hash_is_sha256(tmp_path: Path) -> None:
    (tmp_path / "f").write_bytes(b"abc")
    assert file_sha256(tmp_path / "f").startswith("ba7816bf8f01cfea414140de5dae2223")


# name in the corpus -> (Gaussians, dropped, SH degree, antialiased)
CORPUS = {
    "ascii_sh0.ply": 0, "big_endian_sh3.ply": 3, "comments_gsplat_antialiased.ply": 3,
    "double_sh3.ply": 3, "mipsplatting_filter_3D.ply": 3, "reversed_property_order_sh3.ply": 3,
    "sh0_nonormals.ply": 0, "sh1_nonormals.ply": 1, "sh2_nonormals.ply": 2, "sh3_nonormals.ply": 3,
}  # fmt: skip
REFUSED = {
    "bad_frest_count_10.ply": "f_rest", "bad_missing_opacity.ply": "opacity",
    "bad_truncated_header.ply": "not a readable", "bad_truncated_payload.ply": "not a readable",
    "plain_rgb_pointcloud_not_3dgs.ply": "point cloud",
}  # fmt: skip


@pytest.fixture
def corpus(data_dir: Path) -> Path:
    folder = data_dir / "splats" / "derived"
    if not folder.is_dir():
        pytest.skip(f"no corpus of Gaussian files at {folder}")
    return folder


def test_every_file_of_the_corpus_is_named_here(corpus: Path) -> None:
    named = {*CORPUS, *REFUSED, "bad_nan_inf_zeroquat.ply", "empty_zero_vertices.ply"}
    assert {file.name for file in corpus.iterdir()} == named


@pytest.mark.parametrize("name", CORPUS)
def test_corpus_is_read(corpus: Path, name: str) -> None:
    gmap = load_map(corpus / name)
    assert len(gmap) >= 1000 or name == "ascii_sh0.ply" and len(gmap) > 100
    assert gmap.sh_degree == CORPUS[name] and gmap.dropped == 0
    assert gmap.antialiased == (name == "comments_gsplat_antialiased.ply")
    # all were made from one map: what is there agrees, whatever the layout
    whole = load_map(corpus / "sh3_nonormals.ply")
    count = min(len(gmap), len(whole))
    assert np.allclose(gmap.means[:count], whole.means[:count], atol=1e-5)
    assert np.allclose(gmap.quats_wxyz[:count], whole.quats_wxyz[:count], atol=1e-5)
    k = gmap.sh.shape[1]
    assert np.allclose(gmap.sh[:count], whole.sh[:count, :k], atol=1e-5)
    if name != "mipsplatting_filter_3D.ply":
        assert np.allclose(gmap.opacities[:count], whole.opacities[:count], atol=1e-5)
        assert np.allclose(gmap.scales[:count], whole.scales[:count], rtol=1e-4)
    else:
        assert (gmap.scales[:count] >= whole.scales[:count] * 0.9999).all()
        assert (gmap.opacities[:count] <= whole.opacities[:count] * 1.0001).all()


@pytest.mark.parametrize("name", REFUSED)
def test_corpus_is_refused_with_its_cause(corpus: Path, name: str) -> None:
    with pytest.raises(MapError, match=REFUSED[name]) as caught:
        load_map(corpus / name)
    assert name in str(caught.value) and "\n" not in str(caught.value)


def test_corpus_damage_is_counted(corpus: Path) -> None:
    gmap = load_map(corpus / "bad_nan_inf_zeroquat.ply")
    raw = plyfile.PlyData.read(str(corpus / "bad_nan_inf_zeroquat.ply"))["vertex"].data
    table = np.stack([raw[name].astype(np.float64) for name in raw.dtype.names], 1)
    rotations = np.stack([raw[f"rot_{i}"] for i in range(4)], 1)
    bad = ~np.isfinite(table).all(1) | (np.abs(rotations).max(1) == 0)
    assert bad.sum() > 0
    assert gmap.dropped == bad.sum() and len(gmap) == len(raw) - bad.sum()


def test_corpus_empty(corpus: Path) -> None:
    assert len(load_map(corpus / "empty_zero_vertices.ply")) == 0
