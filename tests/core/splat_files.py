"""Encoders of Gaussian file formats for tests: plain loops, written from the descriptions."""

from __future__ import annotations

import gzip
import json
import struct
from pathlib import Path

import cv2
import numpy as np
import plyfile
import zstandard

from igaussian_core.gaussian_map import GaussianMap

C0 = 0.28209479177387814


def soft_map(count: int = 300, degree: int = 2, seed: int = 0) -> GaussianMap:
    """Gaussians with values that every format can hold: SH within 1, colours within [0, 1]."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    sh = rng.uniform(-0.9, 0.9, (count, (degree + 1) ** 2, 3))
    sh[:, 0] = rng.uniform(-1.7, 1.7, (count, 3))
    return GaussianMap(
        rng.uniform(-3, 3, (count, 3)).astype(np.float32),
        quats.astype(np.float32),
        np.exp(rng.uniform(-6, 1, (count, 3))).astype(np.float32),
        rng.uniform(0.02, 0.98, count).astype(np.float32),
        sh.astype(np.float32),
    )


def write_splat(gmap: GaussianMap, file: Path) -> None:
    def byte(value: float) -> int:
        return int(min(max(round(value), 0), 255))

    records = b""
    for i in range(len(gmap)):
        rgba = [*(0.5 + C0 * gmap.sh[i, 0]), gmap.opacities[i]]
        records += struct.pack("<6f", *gmap.means[i], *gmap.scales[i])
        records += bytes(byte(255 * v) for v in rgba)
        records += bytes(byte(128 * q + 128) for q in gmap.quats_wxyz[i])
    file.write_bytes(records)


def _bits(value: float, width: int) -> int:
    return round(min(max(value, 0.0), 1.0) * ((1 << width) - 1))


def _smallest_three(quat: np.ndarray) -> tuple[int, list[float]]:
    largest = int(np.argmax(np.abs(quat)))
    quat = quat if quat[largest] >= 0 else -quat
    return largest, [float(q) for i, q in enumerate(quat) if i != largest]


def write_compressed_ply(
    gmap: GaussianMap, file: Path, colour_ranges: bool = True, harmonics: bool = True
) -> None:
    count, n_chunks = len(gmap), -(-len(gmap) // 256)
    names = [f"{end}_{axis}" for end in ("min", "max") for axis in "xyz"]
    names += [f"{end}_scale_{axis}" for end in ("min", "max") for axis in "xyz"]
    names += [f"{end}_{c}" for end in ("min", "max") for c in "rgb"] if colour_ranges else []
    chunk = np.zeros(n_chunks, [(n, "<f4") for n in names])
    packed_names = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
    vertex = np.zeros(count, [(n, "<u4") for n in packed_names])
    rgb = 0.5 + C0 * gmap.sh[:, 0]
    for k in range(n_chunks):
        rows = range(256 * k, min(256 * (k + 1), count))
        parts = [(gmap.means, "", "xyz"), (np.log(gmap.scales), "scale_", "xyz")]
        if colour_ranges:
            parts.append((rgb, "", "rgb"))
        ranges = {}
        for values, prefix, axes in parts:
            low, high = values[rows].min(axis=0), values[rows].max(axis=0)
            ranges[prefix + axes] = (low, np.maximum(high - low, 1e-9))
            for j, axis in enumerate(axes):
                chunk[f"min_{prefix}{axis}"][k], chunk[f"max_{prefix}{axis}"][k] = low[j], high[j]
        for i in rows:
            def unit(values: np.ndarray, key: str, i: int = i, ranges: dict = ranges) -> np.ndarray:
                return (values[i] - ranges[key][0]) / ranges[key][1]

            x, y, z = unit(gmap.means, "xyz")
            vertex["packed_position"][i] = _bits(x, 11) << 21 | _bits(y, 10) << 11 | _bits(z, 11)
            x, y, z = unit(np.log(gmap.scales), "scale_xyz")
            vertex["packed_scale"][i] = _bits(x, 11) << 21 | _bits(y, 10) << 11 | _bits(z, 11)
            largest, rest = _smallest_three(gmap.quats_wxyz[i])
            a, b, c = (_bits(r / np.sqrt(2) + 0.5, 10) for r in rest)
            vertex["packed_rotation"][i] = largest << 30 | a << 20 | b << 10 | c
            red, green, blue = unit(rgb, "rgb") if colour_ranges else rgb[i]
            vertex["packed_color"][i] = (
                _bits(red, 8) << 24 | _bits(green, 8) << 16 | _bits(blue, 8) << 8
                | _bits(gmap.opacities[i], 8)
            )  # fmt: skip
    elements = [plyfile.PlyElement.describe(chunk, "chunk"),
                plyfile.PlyElement.describe(vertex, "vertex")]  # fmt: skip
    rest = gmap.sh.shape[1] - 1
    if rest and harmonics:
        data = np.zeros(count, [(f"f_rest_{i}", "u1") for i in range(3 * rest)])
        for c in range(3):
            for k in range(rest):
                level = np.floor((gmap.sh[:, 1 + k, c] / 8 + 0.5) * 256)
                data[f"f_rest_{c * rest + k}"] = np.clip(level, 0, 255)
        elements.append(plyfile.PlyElement.describe(data, "sh"))
    plyfile.PlyData(elements, byte_order="<").write(str(file))


def spz_streams(gmap: GaussianMap, version: int, fractional_bits: int = 12) -> list[bytes]:
    """Attribute streams; `gmap` is written in whatever axes it is in."""
    positions = alphas = colours = scales = rotations = harmonics = b""
    for i in range(len(gmap)):
        for value in gmap.means[i]:
            if version == 1:
                positions += struct.pack("<e", value)
            else:
                fixed = round(float(value) * (1 << fractional_bits)) & 0xFFFFFF
                positions += bytes((fixed & 255, fixed >> 8 & 255, fixed >> 16))
        alphas += bytes([round(255 * float(gmap.opacities[i]))])
        colours += bytes(round(255 * (0.15 * float(v) + 0.5)) for v in gmap.sh[i, 0])
        scales += bytes(round(16 * (float(np.log(v)) + 10)) for v in gmap.scales[i])
        w, x, y, z = (float(v) for v in gmap.quats_wxyz[i])
        if version < 3:
            sign = 1 if w >= 0 else -1
            rotations += bytes(round(127.5 * (sign * v + 1)) for v in (x, y, z))
        else:
            largest, rest = _smallest_three(np.array([x, y, z, w]))
            packed = largest
            for value in rest:
                packed = packed << 10 | (value < 0) << 9 | round(abs(value) * 511 * 2**0.5)
            rotations += struct.pack("<I", packed)
        for k in range(1, gmap.sh.shape[1]):
            harmonics += bytes(round(128 * float(v)) + 128 for v in gmap.sh[i, k])
    return [positions, alphas, colours, scales, rotations, harmonics]


def write_spz(
    gmap: GaussianMap, file: Path, version: int, flags: int = 0, extensions: bytes = b"",
    compress: bool = True,
) -> None:  # fmt: skip
    degree, streams = int(gmap.sh.shape[1] ** 0.5) - 1, spz_streams(gmap, version)
    if version < 4:
        header = struct.pack("<4sIIBBBB", b"NGSP", version, len(gmap), degree, 12, flags, 0)
        data = header + b"".join(streams) + extensions
        file.write_bytes(gzip.compress(data) if compress else data)
        return
    streams = streams if degree else streams[:5]
    packed = [zstandard.compress(stream) for stream in streams]
    table = 32 + len(extensions)
    header = struct.pack(
        "<4sIIBBBBI12x", b"NGSP", 4, len(gmap), degree, 12, flags, len(streams), table
    )
    entries = b"".join(
        struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, streams, strict=True)
    )
    file.write_bytes(header + extensions + entries + b"".join(packed))


def webp(image: np.ndarray) -> bytes:
    """Lossless WebP of RGB or RGBA [H, W, C]."""
    code = cv2.COLOR_RGB2BGR if image.shape[2] == 3 else cv2.COLOR_RGBA2BGRA
    done, data = cv2.imencode(".webp", cv2.cvtColor(image, code), [cv2.IMWRITE_WEBP_QUALITY, 101])
    assert done
    return data.tobytes()


def _picture(values: np.ndarray, width: int) -> np.ndarray:
    height = -(-len(values) // width)
    padded = np.zeros((height * width, values.shape[1]), np.uint8)
    padded[: len(values)] = values
    return padded.reshape(height, width, -1)


def _nearest(codebook: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.abs(codebook - values[..., None]).argmin(axis=-1).astype(np.uint8)


def sog_files(gmap: GaussianMap, version: int = 2, width: int = 20) -> dict[str, bytes]:
    """Names and contents of the files of a .sog; every Gaussian has its own palette entry."""
    count = len(gmap)
    means = np.sign(gmap.means) * np.log1p(np.abs(gmap.means.astype(np.float64)))
    low, high = means.min(axis=0), means.max(axis=0)
    fixed = np.rint((means - low) / (high - low) * 65535).astype(np.uint16)
    quats = np.zeros((count, 4), np.uint8)
    for i in range(count):
        largest, rest = _smallest_three(gmap.quats_wxyz[i])
        quats[i] = [*(round((r * 2**0.5 + 1) * 127.5) for r in rest), 252 + largest]
    log_scales, dc = np.log(gmap.scales), gmap.sh[:, 0]
    meta: dict = {
        "means": {"mins": low.tolist(), "maxs": high.tolist(),
                  "files": ["means_l.webp", "means_u.webp"]},
        "quats": {"files": ["quats.webp"]},
    }  # fmt: skip
    if version == 2:
        books = {n: np.linspace(v.min(), v.max(), 256) for n, v in
                 (("scales", log_scales), ("sh0", dc))}  # fmt: skip
        scales, colours = _nearest(books["scales"], log_scales), _nearest(books["sh0"], dc)
        alpha = np.rint(gmap.opacities * 255)
        meta |= {"version": 2, "count": count}
        meta |= {n: {"codebook": b.tolist(), "files": [f"{n}.webp"]} for n, b in books.items()}
    else:
        logit = np.log(gmap.opacities / (1 - gmap.opacities))[:, None]
        values = {"scales": log_scales, "sh0": np.concatenate([dc, logit], axis=1)}
        codes = {}
        for name, v in values.items():
            # a byte of 0 is no use for alpha: OpenCV's encoder forgets the colour under it
            a, b = v.min(axis=0) - 0.1, v.max(axis=0)
            codes[name] = np.rint((v - a) / (b - a) * 255).astype(np.uint8)
            meta[name] = {"mins": a.tolist(), "maxs": b.tolist(), "files": [f"{name}.webp"]}
        scales, colours, alpha = codes["scales"], codes["sh0"][:, :3], codes["sh0"][:, 3]
        meta["means"]["shape"] = [count, 3]
    files = {
        "means_l.webp": webp(_picture((fixed & 255).astype(np.uint8), width)),
        "means_u.webp": webp(_picture((fixed >> 8).astype(np.uint8), width)),
        "scales.webp": webp(_picture(scales, width)),
        "quats.webp": webp(_picture(quats, width)),
        "sh0.webp": webp(_picture(np.concatenate([colours, alpha[:, None]], 1).astype(np.uint8),
                                  width)),
    }  # fmt: skip
    rest = gmap.sh.shape[1] - 1
    if rest:
        book = np.linspace(gmap.sh[:, 1:].min(), gmap.sh[:, 1:].max(), 256)
        palette = np.zeros((-(-count // 64), 64 * rest, 3), np.uint8)
        for i in range(count):
            palette[i // 64, i % 64 * rest : (i % 64 + 1) * rest] = _nearest(book, gmap.sh[i, 1:])
        labels = np.stack([np.arange(count) & 255, np.arange(count) >> 8, np.zeros(count)], 1)
        files["shN_centroids.webp"] = webp(palette)
        files["shN_labels.webp"] = webp(_picture(labels.astype(np.uint8), width))
        meta["shN"] = {"files": ["shN_centroids.webp", "shN_labels.webp"]}
        meta["shN"] |= (
            {"count": count, "bands": int((rest + 1) ** 0.5) - 1, "codebook": book.tolist()}
            if version == 2
            else {"mins": float(book[0]), "maxs": float(book[-1])}
        )
    files["meta.json"] = json.dumps(meta).encode()
    return files
