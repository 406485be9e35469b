"""One camera written in every format reads back as the same Camera and T_scene_cam."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from igaussian_core.camera import Camera
from igaussian_core.errors import DatasetError, IGaussianError
from igaussian_core.geometry import compose, inverse, quaternion_from_rotation, rotation_from_vector
from igaussian_core.posed_images import PosedImage, read_image, read_posed_images

WIDTH, HEIGHT = 64, 48
# the truth, OpenCV's pixel rule; centred as INRIA's cameras.json can only say
CENTRED = Camera(WIDTH, HEIGHT, 50.0, 51.0, 31.5, 23.5)
LENS = Camera(WIDTH, HEIGHT, 50.0, 51.0, 30.25, 24.0, "plumb_bob", (0.1, -0.02, 1e-3, -2e-3))
POSES = [
    compose(rotation_from_vector([0.3, -0.5, 0.9]), [1.0, -2.0, 3.0]),
    compose(rotation_from_vector([-2.0, 0.4, 0.1]), [-0.5, 0.25, 8.0]),
]
NAMES = ["a.png", "b.png"]


def corner(camera: Camera) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy as files count: from the image's corner."""
    return camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5


def write_poses_json(folder: Path, camera: Camera) -> Path:
    fx, fy, cx, cy = corner(camera)
    frames = [
        {"file": n, "width": WIDTH, "height": HEIGHT, "fx": fx, "fy": fy, "cx": cx, "cy": cy,
         "T_world_cam": T.tolist(), "dist": list(camera.dist)}
        for n, T in zip(NAMES, POSES, strict=True)
    ]  # fmt: skip
    return dump(folder / "poses.json", {"frames": frames})


def nerf_matrix(T_scene_cam: np.ndarray) -> list[list[float]]:
    """OpenGL's axes: x right, y up, z backward."""
    T = T_scene_cam.copy()
    T[:3, 1:3] *= -1
    return T.tolist()


def write_transforms_json(folder: Path, camera: Camera) -> Path:
    fx, fy, cx, cy = corner(camera)
    data: dict[str, Any] = {"w": WIDTH, "h": HEIGHT, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    data |= dict(zip(("k1", "k2", "p1", "p2"), camera.dist, strict=False))
    data["frames"] = [
        {"file_path": n, "transform_matrix": nerf_matrix(T)}
        for n, T in zip(NAMES, POSES, strict=True)
    ]
    return dump(folder / "transforms.json", data)


def write_cameras_json(folder: Path, camera: Camera) -> Path:
    entries = [
        {"id": i, "img_name": n, "width": WIDTH, "height": HEIGHT, "position": T[:3, 3].tolist(),
         "rotation": T[:3, :3].tolist(), "fx": camera.fx, "fy": camera.fy}
        for i, (n, T) in enumerate(zip(NAMES, POSES, strict=True))
    ]  # fmt: skip
    return dump(folder / "cameras.json", entries)


def colmap_model(camera: Camera) -> tuple[str, int, list[float]]:
    kinds = {"plumb_bob": ("OPENCV", 4), "equidistant": ("OPENCV_FISHEYE", 5),
             "rational_polynomial": ("FULL_OPENCV", 6)}  # fmt: skip
    name, number = kinds[camera.model] if camera.dist else ("PINHOLE", 1)
    return name, number, [*corner(camera), *camera.dist]


def colmap_pose(T_scene_cam: np.ndarray) -> list[float]:
    T_cam_scene = inverse(T_scene_cam)
    return [*quaternion_from_rotation(T_cam_scene[:3, :3]), *T_cam_scene[:3, 3]]


def write_colmap_bin(folder: Path, camera: Camera, points: int = 3) -> Path:
    _, number, parameters = colmap_model(camera)
    with open(folder / "cameras.bin", "wb") as f:
        f.write(struct.pack("<Q", 1))
        f.write(struct.pack("<iiQQ", 7, number, WIDTH, HEIGHT))
        f.write(struct.pack(f"<{len(parameters)}d", *parameters))
    with open(folder / "images.bin", "wb") as f:
        f.write(struct.pack("<Q", len(NAMES)))
        for i, (name, T) in reversed(list(enumerate(zip(NAMES, POSES, strict=True)))):
            f.write(struct.pack("<i7di", i + 1, *colmap_pose(T), 7))
            f.write(name.encode() + b"\0" + struct.pack("<Q", points))
            f.write(struct.pack("<ddq", 1.0, 2.0, -1) * points)
    return folder


def write_colmap_txt(folder: Path, camera: Camera, points: str = "1.0 2.0 -1 3.0 4.0 5") -> Path:
    name, _, parameters = colmap_model(camera)
    numbers = " ".join(map(repr, parameters))
    (folder / "cameras.txt").write_text(
        f"# Camera list\n#   CAMERA_ID, MODEL\n7 {name} {WIDTH} {HEIGHT} {numbers}\n"
    )
    lines = ["# Image list with two lines of data per image:", "# Number of images: 2"]
    for i, (name, T) in enumerate(zip(NAMES, POSES, strict=True)):
        lines += [f"{i + 1} {' '.join(map(repr, map(float, colmap_pose(T))))} 7 {name}", points]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


def dump(file: Path, data: Any) -> Path:
    file.write_text(json.dumps(data))
    return file


WRITERS = {
    "poses.json": write_poses_json, "transforms.json": write_transforms_json,
    "cameras.json": write_cameras_json, "colmap bin": write_colmap_bin,
    "colmap txt": write_colmap_txt,
}  # fmt: skip


def assert_truth(images: list[PosedImage], camera: Camera) -> None:
    assert [image.name for image in images] == NAMES
    for image, T in zip(images, POSES, strict=True):
        assert np.allclose(image.T_scene_cam, T, atol=1e-9)
        assert (image.camera.width, image.camera.height) == (WIDTH, HEIGHT)
        assert (image.camera.model, image.camera.dist) == (camera.model, camera.dist)
        assert np.allclose(image.camera.K, camera.K, atol=1e-9)


@pytest.mark.parametrize("writer", WRITERS.values(), ids=WRITERS)
def test_every_format_says_the_same(tmp_path: Path, writer: Any) -> None:
    assert_truth(read_posed_images(writer(tmp_path, CENTRED)), CENTRED)


@pytest.mark.parametrize("name", [name for name in WRITERS if name != "cameras.json"])
def test_every_format_that_knows_lenses(tmp_path: Path, name: str) -> None:
    assert_truth(read_posed_images(WRITERS[name](tmp_path, LENS)), LENS)


@pytest.mark.parametrize("writer", [write_colmap_bin, write_colmap_txt])
@pytest.mark.parametrize(
    "camera",
    [
        Camera(WIDTH, HEIGHT, 50.0, 51.0, 30.0, 24.0, "equidistant", (0.1, 0.2, -0.1, 0.05)),
        Camera(WIDTH, HEIGHT, 50.0, 51.0, 30.0, 24.0, "equidistant", (0.0, 0.0, 0.0, 0.0)),
        Camera(
            WIDTH, HEIGHT, 50.0, 51.0, 30.0, 24.0, "rational_polynomial",
            (0.1, 0.2, 1e-3, 2e-3, 0.3, 0.4, 0.5, 0.6),
        ),
    ],
    ids=["fisheye", "ideal fisheye", "full"],
)  # fmt: skip
def test_colmap_lenses(tmp_path: Path, writer: Any, camera: Camera) -> None:
    assert_truth(read_posed_images(writer(tmp_path, camera)), camera)


@pytest.mark.parametrize(
    ("model", "parameters", "dist"),
    [
        ("SIMPLE_PINHOLE", "50 32 24", ()),
        ("SIMPLE_RADIAL", "50 32 24 0.1", (0.1, 0.0, 0.0, 0.0)),
        ("SIMPLE_RADIAL", "50 32 24 0", ()),
        ("RADIAL", "50 32 24 0.1 -0.2", (0.1, -0.2, 0.0, 0.0)),
    ],
)
def test_colmap_models_with_one_focal_length(
    tmp_path: Path, model: str, parameters: str, dist: tuple[float, ...]
) -> None:
    write_colmap_txt(tmp_path, CENTRED)
    (tmp_path / "cameras.txt").write_text(f"7 {model} {WIDTH} {HEIGHT} {parameters}\n")
    camera = read_posed_images(tmp_path)[0].camera
    assert camera == Camera(WIDTH, HEIGHT, 50.0, 50.0, 31.5, 23.5, "plumb_bob", dist)


def test_colmap_images_without_points(tmp_path: Path) -> None:
    assert_truth(read_posed_images(write_colmap_txt(tmp_path, CENTRED, points="")), CENTRED)
    (tmp_path / "bin").mkdir()
    assert_truth(read_posed_images(write_colmap_bin(tmp_path / "bin", CENTRED, points=0)), CENTRED)


@pytest.mark.parametrize("sub", ["sparse/0", "sparse", "colmap/sparse/0"])
def test_colmap_model_is_found_inside_a_project(tmp_path: Path, sub: str) -> None:
    (tmp_path / sub).mkdir(parents=True)
    write_colmap_bin(tmp_path / sub, CENTRED)
    images = read_posed_images(tmp_path)
    assert_truth(images, CENTRED)
    assert images[0].path == tmp_path / "images" / "a.png"


def test_nerf_angle_of_view_and_suffix(tmp_path: Path) -> None:
    """NeRF Synthetic's files: no size, no suffix, one angle of view."""
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    angle = 2 * np.arctan(0.5 * WIDTH / 50.0)
    frame = {"file_path": "./a", "transform_matrix": nerf_matrix(POSES[0])}
    dump(tmp_path / "transforms_train.json", {"camera_angle_x": angle, "frames": [frame]})
    (image,) = read_posed_images(tmp_path)
    assert image.path == tmp_path / "a.png"
    assert np.allclose(image.camera.K, [[50, 0, 31.5], [0, 50, 23.5], [0, 0, 1]])


def test_nerf_intrinsics_of_a_frame_win(tmp_path: Path) -> None:
    file = write_transforms_json(tmp_path, CENTRED)
    data = json.loads(file.read_text())
    data["frames"][1] |= {"fl_x": 77.0, "cx": 30.0}
    first, second = read_posed_images(dump(file, data))
    assert (first.camera.fx, second.camera.fx, second.camera.cx) == (50.0, 77.0, 29.5)


def test_nerf_fisheye_is_a_fisheye(tmp_path: Path) -> None:
    file = write_transforms_json(tmp_path, CENTRED)
    data = json.loads(file.read_text())
    data |= {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4}
    camera = read_posed_images(dump(file, data))[0].camera
    assert (camera.model, camera.dist) == ("equidistant", (0.1, 0.2, 0.3, 0.4))


def test_nerf_third_radial_coefficient(tmp_path: Path) -> None:
    file = write_transforms_json(tmp_path, LENS)
    data = json.loads(file.read_text())
    data["k3"] = 0.05
    camera = read_posed_images(dump(file, data))[0].camera
    assert (camera.model, camera.dist) == ("plumb_bob", (*LENS.dist, 0.05))


@pytest.mark.parametrize("name", ["EQUIRECTANGULAR", "", 3])
def test_other_nerf_lenses_are_refused(tmp_path: Path, name: object) -> None:
    file = write_transforms_json(tmp_path, CENTRED)
    assert "camera_model" in refused(
        dump(file, json.loads(file.read_text()) | {"camera_model": name})
    )


def refused(path: Path) -> str:
    with pytest.raises(DatasetError) as caught:
        read_posed_images(path)
    text = str(caught.value)
    assert str(path) in text and "\n" not in text
    return text


def test_missing(tmp_path: Path) -> None:
    assert "no such file" in refused(tmp_path / "absent.json")
    assert "supported: poses.json" in refused(tmp_path)


@pytest.mark.parametrize(
    "text",
    ["", "{", "3", "null", "[]", "{}", '{"frames": []}', '{"frames": 3}', '{"frames": [3]}',
     '{"frames": [[1]]}', '{"frames": {"a": 1}}', "[3]", "[[1]]", '["x"]', '{"frames": [null]}',
     '{"frames": [{"file_path": 3}]}', '{"frames": [{"T_world_cam": 1}]}'],
)  # fmt: skip
def test_other_json_is_refused(tmp_path: Path, text: str) -> None:
    file = tmp_path / "x.json"
    file.write_text(text)
    refused(file)


def test_bytes_that_are_no_text(tmp_path: Path) -> None:
    file = tmp_path / "x.json"
    file.write_bytes(bytes(range(256)))
    refused(file)


@pytest.mark.parametrize(
    "change",
    [{"fx": 0}, {"width": 0}, {"fx": None}, {"fx": "wide"}, {"dist": [0.1]}, {"cx": float("nan")},
     {"T_world_cam": [[1, 2], [3, 4]]}, {"T_world_cam": (2 * np.eye(4)).tolist()},
     {"T_world_cam": np.diag([1.0, 1, -1, 1]).tolist()},
     {"T_world_cam": np.full((4, 4), np.nan).tolist()}],
    ids=repr,
)  # fmt: skip
def test_values_without_sense_are_refused(tmp_path: Path, change: dict[str, Any]) -> None:
    file = write_poses_json(tmp_path, CENTRED)
    data = json.loads(file.read_text())
    data["frames"][1] |= change
    refused(dump(file, data))


def test_unknown_colmap_models_are_named(tmp_path: Path) -> None:
    write_colmap_txt(tmp_path, CENTRED)
    (tmp_path / "cameras.txt").write_text(f"7 FOV {WIDTH} {HEIGHT} 50 51 32 24 0.5\n")
    with pytest.raises(DatasetError, match="FOV.*supported: SIMPLE_PINHOLE"):
        read_posed_images(tmp_path)
    (tmp_path / "bin").mkdir()
    write_colmap_bin(tmp_path / "bin", CENTRED)
    (tmp_path / "bin" / "cameras.bin").write_bytes(struct.pack("<QiiQQ", 1, 7, 9, 4, 4))
    with pytest.raises(DatasetError, match="9"):
        read_posed_images(tmp_path / "bin")


def test_colmap_image_of_an_unknown_camera(tmp_path: Path) -> None:
    write_colmap_txt(tmp_path, CENTRED)
    (tmp_path / "cameras.txt").write_text(f"8 PINHOLE {WIDTH} {HEIGHT} 50 51 32 24\n")
    refused(tmp_path)


@pytest.mark.parametrize("name", ["images.bin", "cameras.bin"])
def test_truncated_colmap_files_are_refused(tmp_path: Path, name: str) -> None:
    """Cut anywhere, even inside a name: refused, and not read for ever."""
    write_colmap_bin(tmp_path, CENTRED)
    whole = (tmp_path / name).read_bytes()
    unread = 3 * 24 if name == "images.bin" else 0  # the last image's points are passed over
    for length in [*range(0, len(whole) - unread, 5), len(whole) - unread - 1]:
        (tmp_path / name).write_bytes(whole[:length])
        refused(tmp_path)


def test_colmap_without_cameras(tmp_path: Path) -> None:
    write_colmap_bin(tmp_path, CENTRED)
    (tmp_path / "cameras.bin").unlink()
    refused(tmp_path)


def test_every_refusal_is_a_known_error() -> None:
    assert issubclass(DatasetError, IGaussianError)


def test_read_checks_the_size(tmp_path: Path) -> None:
    image = PosedImage("a.png", tmp_path / "a.png", CENTRED, POSES[0])
    with pytest.raises(DatasetError, match="no such file"):
        image.read()
    cv2.imwrite(str(image.path), np.zeros((HEIGHT, WIDTH - 1, 3), np.uint8))
    with pytest.raises(DatasetError, match="63x48"):
        image.read()


def test_read_image_is_rgb(tmp_path: Path) -> None:
    bgr = np.zeros((4, 5, 3), np.uint8)
    bgr[..., 2] = 200
    cv2.imwrite(str(tmp_path / "red.png"), bgr)
    image = read_image(tmp_path / "red.png")
    assert image.dtype == np.uint8 and image.shape == (4, 5, 3)
    assert image[0, 0].tolist() == [200, 0, 0]


def test_read_image_of_other_kinds(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((4, 5), 77, np.uint8))
    assert read_image(tmp_path / "grey.png")[0, 0].tolist() == [77, 77, 77]
    cv2.imwrite(str(tmp_path / "deep.png"), np.full((4, 5), 77 << 8, np.uint16))
    assert read_image(tmp_path / "deep.png")[0, 0].tolist() == [77, 77, 77]
    rgba = np.zeros((1, 3, 4), np.uint8)
    rgba[0, :, 0] = 200  # blue in OpenCV's order
    rgba[0, :, 3] = [255, 0, 51]
    cv2.imwrite(str(tmp_path / "clear.png"), rgba)
    over_white = read_image(tmp_path / "clear.png", background=(255, 255, 255))
    assert over_white[0].tolist() == [[0, 0, 200], [255, 255, 255], [204, 204, 244]]


def test_read_image_refuses(tmp_path: Path) -> None:
    (tmp_path / "x.png").write_bytes(b"no image")
    with pytest.raises(DatasetError, match="not a readable image"):
        read_image(tmp_path / "x.png")
    with pytest.raises(DatasetError, match="no such file"):
        read_image(tmp_path / "y.png")


def test_real_pose_files(data_dir: Path) -> None:
    images = read_posed_images(data_dir / "sets" / "fox")
    assert len(images) == 50
    image = images[0].read()
    assert image.shape == (images[0].camera.height, images[0].camera.width, 3)
    assert images[0].camera.dist != ()
