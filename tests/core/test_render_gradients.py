"""The native gradients against torch's automatic differentiation of the oracle."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from igaussian_core.camera import Camera
from igaussian_core.errors import CameraError, MapError
from igaussian_core.render import Rasterizer, available_simd, torch_op
from igaussian_core.render.reference import render_reference

CAMERA = Camera(70, 53, 60.0, 62.0, 33.3, 26.1)
BACKGROUND = (0.2, 0.5, 0.7)
NAMES = ("means", "quats_wxyz", "scales", "opacities", "sh", "T_cam_scene")


def scene(seed: int, count: int = 400, sh_count: int = 16) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    arrays = (
        rng.uniform(-2, 2, (count, 3)) + [0, 0, 3],
        rng.normal(size=(count, 4)),
        np.exp(rng.normal(-2.5, 0.8, (count, 3))),
        rng.uniform(0.02, 1, count),
        rng.normal(size=(count, sh_count, 3)) * 0.4,
    )
    return [a.astype(np.float32) for a in arrays]


def pose() -> Tensor:
    T = torch.eye(4, dtype=torch.float64)
    T[:3, :3] = torch.linalg.matrix_exp(
        torch.tensor([[0, -0.1, 0.2], [0.1, 0, -0.05], [-0.2, 0.05, 0]], dtype=torch.float64)
    )
    T[:3, 3] = torch.tensor([-0.3, 0.1, 0.2])
    return T


def loss_weights() -> tuple[Tensor, Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    size = (CAMERA.height, CAMERA.width)
    return (
        torch.randn(*size, 3, generator=generator),
        torch.randn(*size, generator=generator) * 0.1,
        torch.randn(*size, generator=generator),
    )


def loss_of(images: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    weights = loss_weights()
    return sum((image * weight).sum() for image, weight in zip(images, weights, strict=True))


@pytest.fixture(autouse=True)
def fresh_cache() -> None:
    torch_op.clear_cache()


@pytest.mark.parametrize("simd", available_simd())
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("sh_count", [1, 4, 9, 16])
def test_gradients_agree_with_the_oracle(
    simd: str, antialiased: bool, sh_count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("IGAUSSIAN_SIMD", simd)
    arrays = scene(sh_count, sh_count=sh_count)
    options = {"background": BACKGROUND, "antialiased": antialiased}
    ours = [torch.tensor(a, requires_grad=True) for a in arrays] + [pose().requires_grad_()]
    loss_of(torch_op.render(*ours[:5], CAMERA, ours[5], **options)).backward()
    truth = [torch.tensor(a, dtype=torch.float64, requires_grad=True) for a in arrays]
    truth.append(pose().requires_grad_())
    loss_of(render_reference(*truth[:5], CAMERA, truth[5], **options)[:3]).backward()
    for name, mine, theirs in zip(NAMES, ours, truth, strict=True):
        scale = theirs.grad.abs().max()
        error = (mine.grad.double() - theirs.grad).abs().max()
        assert error < 2e-3 * scale, f"{name}: {error:g} of {scale:g}"
        similarity = torch.cosine_similarity(
            mine.grad.double().flatten(), theirs.grad.flatten(), dim=0
        )
        assert similarity > 0.99999, name


def smooth_scene() -> list[Tensor]:
    """Few Gaussians, wide, faint and far apart in depth: their order stays. Differences see the
    rim alpha = 1/255 move, gradients do not: they agree to a few per cent only."""
    rng = np.random.default_rng(3)
    count = 10
    means = np.stack(
        [
            rng.uniform(-0.5, 0.5, count),
            rng.uniform(-0.4, 0.4, count),
            np.linspace(2, 5, count),
        ],
        1,
    )
    arrays = (
        means,
        rng.normal(size=(count, 4)),
        rng.uniform(0.2, 0.5, (count, 3)),
        rng.uniform(0.3, 0.6, count),
        rng.normal(size=(count, 9, 3)) * 0.3,
    )
    return [torch.tensor(a.astype(np.float32)) for a in arrays]


def smooth_loss(images: tuple[Tensor, Tensor, Tensor]) -> Tensor:
    y, x = torch.meshgrid(
        torch.linspace(-1, 1, CAMERA.height), torch.linspace(-1, 1, CAMERA.width), indexing="ij"
    )
    window = torch.exp(-2 * (x * x + y * y))
    wave = window * torch.sin(3 * x + 2 * y + 1)
    rgb, depth, alpha = (image.double() for image in images)
    colour = (rgb * torch.stack([wave, window, wave * wave], -1)).sum()
    # depth alone jumps where alpha comes to 1/255
    return (colour + (depth * alpha * wave).sum() * 0.2 + (alpha * wave).sum()) / 100


def moved(twist: Tensor) -> Tensor:
    """exp(twist) @ pose(), twist = (x, y, z, rx, ry, rz)."""
    x, y, z, a, b, c = twist.unbind()
    zero = torch.zeros((), dtype=twist.dtype)
    rows = [[zero, -c, b, x], [c, zero, -a, y], [-b, a, zero, z], [zero] * 4]
    return torch.linalg.matrix_exp(torch.stack([torch.stack(row) for row in rows])) @ pose()


def test_the_pose_gradient_agrees_with_finite_differences() -> None:
    tensors = smooth_scene()

    def loss(twist: Tensor) -> Tensor:
        images = torch_op.render(*tensors, CAMERA, moved(twist), background=BACKGROUND)
        return smooth_loss(images)

    twist = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    loss(twist).backward()
    largest = float(twist.grad.abs().max())
    for k in range(6):
        offset = torch.zeros(6, dtype=torch.float64)
        offset[k] = step = 5e-3
        numeric = float(loss(offset) - loss(-offset)) / (2 * step)
        assert float(twist.grad[k]) == pytest.approx(numeric, abs=0.04 * largest)


@pytest.mark.parametrize("which", range(5))
def test_gradients_by_the_gaussians_agree_with_finite_differences(
    which: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    # the others keep colours as fp16, whose steps are too coarse for small differences
    monkeypatch.setenv("IGAUSSIAN_SIMD", "portable")
    tensors = smooth_scene()

    def loss(values: Tensor) -> Tensor:
        some = [values if k == which else tensor for k, tensor in enumerate(tensors)]
        return smooth_loss(torch_op.render(*some, CAMERA, pose(), background=BACKGROUND))

    values = tensors[which].clone().requires_grad_()
    loss(values).backward()
    generator = torch.Generator().manual_seed(which)
    for _ in range(4):
        direction = torch.randn(values.shape, generator=generator)
        step = 1e-2
        numeric = float(
            loss(tensors[which] + step * direction) - loss(tensors[which] - step * direction)
        ) / (2 * step)
        analytic = float((values.grad * direction).sum())
        size = float(values.grad.norm())
        assert analytic == pytest.approx(numeric, abs=0.06 * size)


def test_a_gradient_by_one_image_alone() -> None:
    arrays = scene(2, sh_count=1)
    rasterizer = Rasterizer(*arrays)
    weight = loss_weights()[1]
    ours = rasterizer.gradients(CAMERA, pose().numpy(), tuple(arrays), depth=weight.numpy())
    truth = [torch.tensor(a, dtype=torch.float64, requires_grad=True) for a in arrays]
    (render_reference(*truth, CAMERA, pose()).depth * weight).sum().backward()
    scale = truth[0].grad.abs().max()
    assert np.abs(ours.means - truth[0].grad.numpy()).max() < 2e-3 * scale
    assert not ours.sh.any()


def test_gradients_do_not_depend_on_threads() -> None:
    arrays = scene(4)
    rasterizer = Rasterizer(*arrays)
    weight = loss_weights()[0].numpy()
    one, four = (
        rasterizer.gradients(CAMERA, pose().numpy(), tuple(arrays), rgb=weight, threads=threads)
        for threads in (1, 4)
    )
    for a, b in zip(one, four, strict=True):
        np.testing.assert_array_equal(a, b)


def test_gradients_of_other_sizes_are_refused() -> None:
    arrays = scene(4)
    rasterizer = Rasterizer(*arrays)
    with pytest.raises(CameraError, match="gradient has shape"):
        rasterizer.gradients(CAMERA, np.eye(4), tuple(arrays), rgb=np.zeros((3, 3, 3)))
    with pytest.raises(MapError, match="was made of 400"):
        rasterizer.gradients(CAMERA, np.eye(4), tuple(a[:9] for a in arrays))


def test_the_operator_is_registered_properly() -> None:
    inputs = [torch.tensor(a, requires_grad=True) for a in scene(1, 30, 4)]
    settings = ([20, 10], [15.0, 15.0, 9.5, 4.5], [0.0, 0.0, 0.0], 0.01, False)
    torch.library.opcheck(
        torch_op._render_op,
        (*inputs, pose().requires_grad_(), *settings),
        test_utils=("test_schema", "test_autograd_registration", "test_faketensor"),
    )


def test_a_changed_tensor_is_packed_again() -> None:
    tensors = [torch.tensor(a) for a in scene(1, 50, 1)]
    first = torch_op.render(*tensors, CAMERA, pose())[0]
    again = torch_op.render(*tensors, CAMERA, pose())[0]
    assert torch.equal(first, again)
    tensors[4] += 1.0
    assert not torch.equal(first, torch_op.render(*tensors, CAMERA, pose())[0])


def test_float64_maps_and_distorted_cameras_are_refused() -> None:
    tensors = [torch.tensor(a) for a in scene(1, 5, 1)]
    with pytest.raises(MapError, match="float32"):
        torch_op.render(tensors[0].double(), *tensors[1:], CAMERA, pose())
    with pytest.raises(CameraError, match="undistorted"):
        torch_op.render(
            *tensors, Camera(64, 48, 60, 60, 31, 23, "plumb_bob", (0.1, 0, 0, 0)), pose()
        )


def test_gradient_descent_finds_a_shifted_camera() -> None:
    """The whole chain: a photometric loss moves the camera back to where the image was taken."""
    tensors = [torch.tensor(a) for a in scene(7, 300, 4)]
    tensors[2] = tensors[2].clamp_min(0.1)
    with torch.no_grad():
        target = torch_op.render(*tensors, CAMERA, pose())[0]
    shift = torch.tensor([0.06, -0.04, 0.05], dtype=torch.float64)
    start = float(shift.norm())
    shift.requires_grad_()
    optimizer = torch.optim.Adam([shift], lr=0.005)
    for _ in range(60):
        T = pose()
        T = torch.cat([T[:, :3], (T[:, 3] + torch.cat([shift, shift.new_zeros(1)]))[:, None]], 1)
        loss = (torch_op.render(*tensors, CAMERA, T)[0] - target).square().mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert float(shift.detach().norm()) < 0.1 * start
