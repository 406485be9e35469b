"""Training of the pose network: its truth, its loss, its resumption, its report."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from igaussian_core.coarse.attention import NetworkConfig, PoseNetwork
from igaussian_core.coarse.network import (
    MapNetwork,
    NetworkLocalizer,
    load_checkpoint,
    save_checkpoint,
    shipped_checkpoint,
)
from igaussian_core.coarse.pose_scale import expanded
from igaussian_core.config import Config
from igaussian_core.errors import ConfigError, MapError
from igaussian_core.evaluate.coarse_estimator import CoarseOnly
from igaussian_core.geometry import (
    inverse,
    is_rigid,
    rotation_angle_deg,
    rotation_from_vector,
    transform_points,
)
from igaussian_core.localizer import Localizer
from igaussian_core.map_package import MapPackage, NetworkData, open_package
from igaussian_core.query import Query
from igaussian_core.sphere import Sphere
from igaussian_core.timing import StageTimer
from igaussian_core.training.augment import augmented, composite
from igaussian_core.training.bank import Bank, Views, draw_views
from igaussian_core.training.curves import plot_curve, write_tensorboard
from igaussian_core.training.map_network import (
    Setting,
    remember,
    setting_of,
    train_map_network,
    trained_network,
    training_map,
)
from igaussian_core.training.pose_network import (
    MapTrainer,
    TrainOptions,
    held_out_errors,
    recall_loss,
    rotation_error_deg,
)
from igaussian_core.training.poses import PoseSampler
from igaussian_core.training.recent_views import RecentViews

SMALL = NetworkConfig(width=64)


@pytest.fixture(scope="module")
def package(room_igmap: Path) -> MapPackage:
    return open_package(room_igmap)


@pytest.fixture(scope="module")
def setting(package: MapPackage) -> Setting:
    return setting_of(package, sources=6)


def test_degrees_agree_with_numpy_and_their_gradient_is_finite_at_zero() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        a, b = (rotation_from_vector(rng.normal(0, 1.2, 3)) for _ in range(2))
        wanted = rotation_angle_deg(a.T @ b)
        got = rotation_error_deg(torch.tensor(a)[None], torch.tensor(b)[None])[0]
        assert got.item() == pytest.approx(wanted, abs=1e-3)
    same = torch.eye(3)[None].requires_grad_()
    rotation_error_deg(same, torch.eye(3)[None]).sum().backward()
    assert same.grad is not None and torch.isfinite(same.grad).all()


@pytest.mark.parametrize("kind", ["object", "scene"])
def test_training_poses(kind: str) -> None:
    sphere = Sphere(kind, 4.0 if kind == "object" else 0.1, (1.0, 2.0, 3.0), (0.0, 0.0, 1.0))
    known = np.tile(np.eye(4), (5, 1, 1))
    known[:, :3, 3] = np.random.default_rng(1).normal(size=(5, 3)) + (1, 2, 3)
    poses = PoseSampler(sphere, 4.0 if kind == "object" else 1.0, known, 0.0).draw(
        np.random.default_rng(0), 400
    )
    assert all(is_rigid(T) for T in poses)
    offset = poses[:, :3, 3] - sphere.centre
    if kind == "object":
        distance = np.linalg.norm(offset, axis=1)
        assert distance.min() > 3.6 and distance.max() < 4.4
        towards = -(offset * poses[:, :3, 2]).sum(1) / distance
        assert np.degrees(np.arccos(towards.min())) < 15  # the protocol's offset of 0.2 and more
    forward = poses[:, :3, 2]
    # all directions: every octant has its share
    octants = ((forward > 0) @ [1, 2, 4]).astype(int)
    assert np.bincount(octants, minlength=8).min() > 20


def test_poses_near_known_ones_stay_near() -> None:
    known = np.tile(np.eye(4), (8, 1, 1))
    known[:, 0, 3] = np.linspace(0, 2, 8)
    sampler = PoseSampler(Sphere("scene", 0.1), 1.0, known, 1.0)
    poses = sampler.draw(np.random.default_rng(0), 300)
    distance = np.linalg.norm(poses[:, None, :3, 3] - known[None, :, :3, 3], axis=2).min(1)
    assert np.median(distance) < 0.25 and distance.max() < 1.2


def test_the_cells_scene_coordinates_project_to_the_cells(setting: Setting) -> None:
    renderer = setting.renderer
    T = setting.source_poses
    views, _ = renderer.render(T)
    from igaussian_core.coarse.canonical import cell_centres

    scale, centres = renderer.scale, cell_centres(renderer.camera)
    for index in range(len(T)):
        points = scale.scene(expanded(views.points[index].double().numpy()))
        known = views.known[index].numpy()
        in_camera = transform_points(inverse(T[index]), points[known])
        assert np.abs(renderer.camera.project(in_camera) - centres[known]).max() < 0.01
        assert np.allclose(views.rotation[index], T[index, :3, :3], atol=1e-6)
        assert np.allclose(scale.scene(views.position[index]), T[index, :3, 3], atol=1e-5)


def test_training_views_look_like_large_images_made_small(
    package: MapPackage, setting: Setting
) -> None:
    camera, T = setting.renderer.camera, setting.source_poses[:1]
    large = camera.resized(5 * camera.width, 5 * camera.height)
    rgb, _, _ = package.gaussians.render(large, inverse(T[0]))
    wanted = 255 * rgb.reshape(camera.height, 5, camera.width, 5, 3).mean((1, 3))
    small = dataclasses.replace(setting.renderer, oversampling=1)
    compensated = dataclasses.replace(small, gmap=package.gaussians.for_small_images())
    averaged, swollen, soft = (
        np.abs(r.render(T)[0].rgba[0, ..., :3].numpy() - wanted).mean()
        for r in (setting.renderer, small, compensated)
    )
    assert averaged < 0.5 * soft and soft < 0.8 * swollen


def test_views_that_show_nothing_are_not_used(setting: Setting) -> None:
    away = dataclasses.replace(setting.renderer, min_covered=1.1, oversampling=1)
    with pytest.raises(MapError, match="shows too little .*: 0 of"):
        draw_views(away, setting.sampler, np.random.default_rng(0), 8)


def test_the_bank_gives_each_view_once_and_renews_the_oldest(setting: Setting) -> None:
    bank = Bank(setting.renderer, setting.sampler, 12, seed=3)
    before = bank.views.rgba.clone()
    seen = torch.cat([bank.batch(4).position for _ in range(3)])
    assert len(torch.unique(seen, dim=0)) == 12
    bank.refresh(5)
    changed = (bank.views.rgba != before).flatten(1).any(1)
    assert changed[:3].any() and not changed[5:].any()


def test_augmentation_changes_every_image_and_no_size(setting: Setting) -> None:
    views = draw_views(setting.renderer, setting.sampler, np.random.default_rng(0), 16)
    plain = composite(views.rgba, torch.zeros(1, 3)).permute(0, 3, 1, 2)
    random = torch.Generator().manual_seed(0)
    images = augmented(views.rgba, torch.zeros(3), random)
    assert images.shape == plain.shape
    assert images.min() >= 0 and images.max() <= 1
    difference = (images - plain).abs().flatten(1).mean(1)
    assert (difference > 0.002).all() and difference.median() < 0.3
    again = augmented(views.rgba, torch.zeros(3), torch.Generator().manual_seed(0))
    assert torch.equal(images, again)


OPTIONS = TrainOptions(steps=90, batch=16, learning_rate=2e-3, validate_every=45, refresh=2)


@pytest.fixture(scope="module")
def learned(package: MapPackage, setting: Setting) -> tuple[MapNetwork, MapTrainer]:
    """A network after some seconds of training in the test's room."""
    torch.manual_seed(0)
    data = training_map("room", setting, 192, 0, held_out=48)
    trainer = MapTrainer(PoseNetwork(SMALL), data, OPTIONS)
    trainer.run()
    memory = remember(trainer.network, data, setting, 400, seed=0)
    return trained_network(trainer.network, data, setting, OPTIONS, memory), trainer


def test_training_lowers_the_error_on_views_it_has_not_seen(
    learned: tuple[MapNetwork, MapTrainer], setting: Setting
) -> None:
    trained, trainer = learned
    torch.manual_seed(0)
    before = np.median(held_out_errors(PoseNetwork(SMALL).eval(), trainer.map)[0])
    report = trained.report
    assert report["held_out_views"] == 48
    assert report["median_deg"] < 0.7 * before
    assert report["median_distance"] < 0.6 * setting.renderer.scale.length
    assert trainer.curve.steps == [45, 90]
    assert trainer.curve.values["loss"][1] < trainer.curve.values["loss"][0]
    assert trainer.curve.values["degrees"][1] < trainer.curve.values["degrees"][0]
    assert np.isfinite(trainer.curve.values["loss"]).all()


def test_the_latest_views_tell_a_pose_that_keys_tell() -> None:
    random = torch.Generator().manual_seed(0)
    keys = torch.randn(700, 8, generator=random)
    angles = 0.3 * keys[:, 0]
    zero, one = torch.zeros_like(angles), torch.ones_like(angles)
    turns = [angles.cos(), -angles.sin(), zero, angles.sin(), angles.cos(), zero, zero, zero, one]
    nothing = torch.zeros(700, 1)
    views = Views(
        nothing, nothing, nothing, torch.stack(turns, 1).reshape(-1, 3, 3), 0.1 * keys[:, 1:4]
    )
    recent = RecentViews()
    assert recent.predict(keys) is None
    recent.add(keys[:600], Views(*(part[:600] for part in views)))
    asked = keys[600:].clone().requires_grad_()
    predicted = recent.predict(asked)
    assert predicted is not None
    truth = Views(*(part[600:] for part in views))
    loss = recall_loss(predicted, truth, torch.full((100,), 30.0))
    unknown = recall_loss(predicted.roll(1, 0), truth, torch.full((100,), 30.0))
    assert loss < 0.5 * unknown
    loss.backward()
    assert asked.grad is not None and torch.isfinite(asked.grad).all() and asked.grad.any()


def test_an_interrupted_training_goes_on(setting: Setting, tmp_path: Path) -> None:
    torch.manual_seed(0)
    data = training_map("room", setting, 64, 0, held_out=8)
    options = dataclasses.replace(OPTIONS, steps=8, validate_every=4, refresh=0)
    checkpoint = tmp_path / "training"

    class Stop(Exception):
        pass

    def stop(stage: str, done: int, of: int) -> None:
        if done == 5:
            raise Stop

    first = MapTrainer(PoseNetwork(SMALL), data, options, checkpoint)
    first.save_every = 4
    with pytest.raises(Stop):
        first.run(stop)
    assert checkpoint.is_file()
    second = MapTrainer(PoseNetwork(SMALL), data, options, checkpoint)
    assert second.step == 4
    curve = second.run()
    assert curve.steps == [4, 8] and not checkpoint.exists()

    checkpoint.write_text("nothing")
    with pytest.raises(ConfigError, match="unreadable checkpoint"):
        MapTrainer(PoseNetwork(SMALL), data, options, checkpoint)


def test_the_same_seed_gives_the_same_network(setting: Setting) -> None:
    weights = []
    for _ in range(2):
        torch.manual_seed(0)
        data = training_map("room", setting, 48, 0, held_out=8)
        options = dataclasses.replace(OPTIONS, steps=4, validate_every=4)
        trainer = MapTrainer(PoseNetwork(SMALL), data, options)
        trainer.run()
        weights.append(trainer.network.state_dict()["decode.weight"].clone())
    assert torch.equal(*weights)


def test_a_map_keeps_its_network(
    learned: tuple[MapNetwork, MapTrainer], package: MapPackage
) -> None:
    trained, _ = learned
    again = MapNetwork.from_data(trained.data(), "here")
    image = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    camera = package.landmarks.intrinsics[0]
    from igaussian_core.camera import Camera

    camera = Camera(320, 240, *map(float, camera[2:]))
    a, b = (next(NetworkLocalizer(m, 3).hypotheses(image, camera)) for m in (trained, again))
    assert np.allclose(a.T_scene_cam, b.T_scene_cam, atol=1e-2)
    assert again.report == trained.report and again.camera == trained.camera


@pytest.mark.parametrize("head", ["memory", "attention"])
def test_hypotheses_differ_from_each_other(
    learned: tuple[MapNetwork, MapTrainer], head: str
) -> None:
    trained, _ = learned
    image = np.random.default_rng(0).integers(0, 255, (240, 320, 3), dtype=np.uint8)
    camera = trained.camera.resized(320, 240)
    found = list(NetworkLocalizer(trained, 4, head).hypotheses(image, camera))
    assert 1 <= len(found) <= 4 and all(h.source == "network" for h in found)
    assert all(is_rigid(h.T_scene_cam) for h in found)


def test_the_memory_knows_the_map_better_than_the_heads(
    learned: tuple[MapNetwork, MapTrainer], setting: Setting
) -> None:
    """After seconds of training, which are too few for the heads."""
    trained, trainer = learned
    by_heads = np.median(held_out_errors(trained.network, trainer.map)[0])
    assert trained.report["memory"] == 400
    assert trained.report["median_deg"] < 0.8 * by_heads
    assert not trained.network.training


def test_an_old_network_without_a_memory_predicts_by_its_heads(
    learned: tuple[MapNetwork, MapTrainer]
) -> None:
    data = learned[0].data()
    tensors = {k: v for k, v in data.tensors.items() if not k.startswith("memory.")}
    old = MapNetwork.from_data(NetworkData(tensors, data.meta), "here")
    assert old.memory is None
    image, camera = np.full((240, 320, 3), 90, np.uint8), old.camera.resized(320, 240)
    asked = [NetworkLocalizer(old, 1, head).hypotheses(image, camera)
             for head in ("memory", "attention")]  # fmt: skip
    a, b = (next(hypotheses).T_scene_cam for hypotheses in asked)
    assert np.array_equal(a, b)


@pytest.mark.parametrize("damage", ["missing", "extra", "shape", "memory", "nan", "format"])
def test_damaged_networks_are_refused(
    learned: tuple[MapNetwork, MapTrainer], damage: str
) -> None:
    data = learned[0].data()
    tensors, meta = dict(data.tensors), dict(data.meta)
    if damage == "missing":
        del tensors["network.decode.weight"]
    elif damage == "memory":
        del tensors["memory.coefficients"]
    elif damage == "nan":
        tensors["memory.width"] = np.array([np.nan], np.float32)
    elif damage == "extra":
        tensors["network.more"] = np.zeros(3, np.float32)
    elif damage == "shape":
        tensors["network.decode.bias"] = np.zeros(3, np.float32)
    else:
        meta["format"] = "other"
    with pytest.raises(MapError, match="room.igmap"):
        MapNetwork.from_data(NetworkData(tensors, meta), "room.igmap")


def test_checkpoints(tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = PoseNetwork(SMALL)
    save_checkpoint(network, tmp_path / "joint.safetensors", {"steps": 1})
    again = load_checkpoint(tmp_path / "joint.safetensors")
    for name, value in network.state_dict().items():
        assert torch.allclose(again.state_dict()[name].float(), value.float(), atol=2e-3), name
    with pytest.raises(MapError, match="none.safetensors"):
        load_checkpoint(tmp_path / "none.safetensors")
    (tmp_path / "bad.safetensors").write_bytes(b"12345678901234567890")
    with pytest.raises(MapError, match="bad.safetensors"):
        load_checkpoint(tmp_path / "bad.safetensors")


def test_the_shipped_checkpoint_opens_and_is_small() -> None:
    file = shipped_checkpoint()
    assert file.stat().st_size < 25e6
    network = load_checkpoint(file)
    assert network.config == NetworkConfig()


def test_training_may_be_left_out(package: MapPackage) -> None:
    options = TrainOptions(steps=0)
    torch.manual_seed(0)
    trained, curve = train_map_network(
        package, PoseNetwork(SMALL), options, sources=4, bank=8, memory=0
    )
    assert curve.steps == [] and trained.views.features.shape[:2] == (1, 4)
    assert trained.memory is None and trained.report["memory"] == 0


def test_curves(learned: tuple[MapNetwork, MapTrainer], tmp_path: Path) -> None:
    curve = learned[1].curve
    plot_curve(curve, tmp_path / "curve.png")
    picture = cv2.imread(str(tmp_path / "curve.png"))
    assert picture is not None and picture.std() > 5
    write_tensorboard(curve, tmp_path / "board")
    assert any((tmp_path / "board").glob("events.out.tfevents*"))


def test_the_localizer_asks_the_network_first(
    learned: tuple[MapNetwork, MapTrainer], package: MapPackage
) -> None:
    """After seconds of training it is far off: in the cascade the landmarks take over."""
    import room as rooms

    with_network = dataclasses.replace(package, network=learned[0].data())
    T = rooms.source_poses()[0]
    rgb, _, _ = package.gaussians.render(rooms.CAMERA, inverse(T))
    image = np.asarray(np.clip(rgb * 255 + 0.5, 0, 255), np.uint8)
    cascade = Localizer(with_network, Config.from_flat({"runtime.budget_ms": 60000.0}))
    cascade.warm_up()
    result = cascade.localize(image, rooms.CAMERA)
    query = Query(image, rooms.CAMERA, cascade._matcher, 256, StageTimer())
    asked = [(h.source, h.align, h.describe) for h in cascade._hypotheses(query, None)]
    assert asked[0] == ("network", True, False) and asked[-1] == ("network", False, True)
    assert ("landmarks", True, True) in asked
    assert result.ok and result.source in ("network", "landmarks")
    alone = Localizer(with_network, Config.from_flat({"coarse.method": "network"}))
    assert alone.localize(image, rooms.CAMERA).source == "network"
    assert CoarseOnly(with_network, Config()).localize(image, rooms.CAMERA).source == "network"


def test_a_map_without_a_network_cannot_be_asked(package: MapPackage) -> None:
    with pytest.raises(MapError, match="igaussian train map"):
        Localizer(package, Config.from_flat({"coarse.method": "network"}))
    with pytest.raises(MapError, match="no pose network"):
        CoarseOnly(package, Config.from_flat({"coarse.method": "network"}))
    assert Localizer(package, Config()) is not None  # the cascade then has the landmarks alone
