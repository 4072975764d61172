"""The method on a GPU: kernels, maps and losses agree with the CPU, and every command works. Skipped without
a GPU, as in CI.
"""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.attach import attach_neilf, pixel_batch
from neilfpp_method.cli import main
from neilfpp_method.data.files.images import write_exr
from neilfpp_method.kernels import encode, grid_spec
from neilfpp_method.schedule import Stage, active_losses, weigh
from neilfpp_method.settings.presets import PRESETS
from neilfpp_method.settings.types import NeilfConfig
from tests.calls import train_tiny
from tests.hosts.balls import BallHost, ball_rays
from tests.hosts.test_mesh import SPHERE, mesh_host
from tests.scenes import sphere_batch, sphere_model, tiny_config
from tests.train.small_runs import short_light_fits, small_config, solved_light
from tests.train.test_resume import interrupt_at

DEVICE = "cuda"
pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")


def solved_config() -> NeilfConfig:
    return solved_light(small_config())


@pytest.fixture(autouse=True)
def _tiny_preset(monkeypatch):
    monkeypatch.setitem(PRESETS, "tiny", solved_config)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory, masked_capture: Path) -> Path:
    out = tmp_path_factory.mktemp("runs") / "sphere"
    return train_tiny(masked_capture, out, "--device", DEVICE, config=solved_config)


@pytest.mark.parametrize(("dtype", "close"), [(torch.float64, 1e-10), (torch.float32, 1e-4)])
@pytest.mark.parametrize("jacobian", [False, True])
def test_encoding_agrees_with_the_reference(dtype, close, jacobian):
    generator = torch.Generator().manual_seed(0)
    results = []
    for backend, device in (("reference", "cpu"), ("reference", DEVICE), ("auto", DEVICE)):
        spec = grid_spec(
            levels=4, features=3, log2_entries=8, base_resolution=3, max_resolution=50, backend=backend
        )
        generator.manual_seed(0)
        table = torch.randn(spec.entries, 3, dtype=dtype, generator=generator)
        x = 1.2 * torch.rand(3000, 3, dtype=dtype, generator=generator) - 0.1  # some lie outside of the cube
        x, table = x.to(device).requires_grad_(), table.to(device).requires_grad_()
        encoded = encode(x, table, spec, jacobian)
        outputs = [encoded.features, encoded.jacobian] if jacobian else [encoded.features]
        weights = [torch.randn(o.shape, dtype=dtype, generator=generator).to(device) for o in outputs]
        torch.autograd.backward(outputs, weights)
        results.append([o.detach().cpu() for o in (*outputs, x.grad, table.grad)])
    for got in results[1:]:
        for one, expected in zip(got, results[0], strict=True):
            torch.testing.assert_close(one, expected, rtol=close, atol=close * float(expected.abs().max()))


def test_maps_agree_with_the_cpu():
    """Samples differ a little: on a CPU, rays whose samples are accurate enough get no further ones."""
    model = sphere_model().eval()
    rays = sphere_batch(400).rays
    expected = model.maps(rays)
    found = copy.deepcopy(model).to(DEVICE).maps(rays.to(DEVICE))
    for name, close in (("rgb_volume", 1e-3), ("opacity", 1e-3), ("base_color", 1e-3), ("normal", 1e-2)):
        difference = (getattr(found, name).cpu() - getattr(expected, name)).abs().amax(-1)
        assert float(difference.median()) < close, name
        assert float(difference.quantile(0.95)) < 5 * close, name


@pytest.mark.parametrize("background", ["constant", "surrounding"])
@pytest.mark.parametrize("stage", list(Stage))
@pytest.mark.parametrize("light", ["free", "solved"])
def test_losses_and_gradients_are_those_of_the_cpu(light, stage, background):
    """Samples are random and differ between devices, so means over many rays are compared."""
    config = tiny_config() if light == "free" else solved_light(tiny_config())
    batch = sphere_batch(2000)
    totals = []
    for device in ("cpu", DEVICE):
        model = sphere_model(config, background=background).to(device)
        model.freeze_for(stage)
        torch.manual_seed(1)
        total = weigh(model.losses(batch.to(device), stage), active_losses(stage, config, model.stages))
        total.loss.backward()
        gradients = [p.grad for p in model.parameters() if p.grad is not None]
        assert gradients
        assert all(bool(g.isfinite().all()) for g in gradients)
        assert all(g.device.type == device for g in gradients)
        totals.append(float(total.loss))
    assert totals[1] == pytest.approx(totals[0], rel=0.05)


def test_a_mesh_is_traced_as_on_the_cpu():
    host = mesh_host(SPHERE)
    rays = ball_rays(500)
    expected = host.render(rays)
    found = copy.deepcopy(host).to(DEVICE).render(rays.to(DEVICE))
    torch.testing.assert_close(found.opacity.cpu(), expected.opacity)
    torch.testing.assert_close(found.position.cpu(), expected.position, rtol=1e-3, atol=1e-3)


def test_attaches_to_a_host_on_the_gpu():
    config = dataclasses.replace(
        tiny_config(),
        train=dataclasses.replace(tiny_config().train, sdf_steps=0, material_steps=20, joint_steps=10),
    )
    host = BallHost().to(DEVICE)
    neilf = attach_neilf(host, config)
    optimizer = torch.optim.Adam([*host.parameters(), *neilf.parameters()], 1e-2)
    rays = ball_rays(256).to(DEVICE)
    color = torch.tensor([[0.4, 0.2, 0.1]], device=DEVICE).expand(256, 3)
    losses = []
    for step in range(30):
        loss = neilf.losses(pixel_batch(rays.origins, rays.directions, color), step).loss
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(float(loss.detach()))
    assert np.isfinite(losses).all()
    assert losses[19] < losses[0]
    maps = neilf.maps(rays)
    assert maps.base_color.device.type == DEVICE
    assert bool(maps.rgb.isfinite().all())


def test_a_stopped_run_is_resumed(masked_capture, tmp_path):
    out = tmp_path / "stopped"
    device = ("--device", DEVICE)
    with short_light_fits():
        with pytest.MonkeyPatch.context() as patch:
            interrupt_at(patch, 6)
            data = ("--data", str(masked_capture), "--preset", "tiny")
            assert main(["train", *data, "--out", str(out), *device]) == 130
        assert main(["train", "--out", str(out), "--resume", *device]) == 0
    assert (out / "report.html").exists()


@pytest.mark.parametrize("device", [DEVICE, "cpu"])
@pytest.mark.parametrize(
    "command",
    [
        ["eval"],
        ["render", "--views", "test"],
        ["export", "--what", "asset"],
        ["export", "--what", "mesh"],
        ["export", "--what", "light"],
        ["report"],
    ],
    ids=" ".join,
)
def test_commands_read_the_run_on_both_devices(trained, command, device):
    assert main([command[0], str(trained), *command[1:], "--device", device]) == 0


def test_relights(trained, tmp_path):
    sky = tmp_path / "sky.exr"
    write_exr(sky, {"RGB": np.full((8, 16, 3), 0.7, np.float32)})
    arguments = ["relight", str(trained), "--env", str(sky), "--spp", "4", "--device", DEVICE]
    assert main([*arguments, "--out", str(tmp_path / "relit")]) == 0
    assert list((tmp_path / "relit").rglob("*.exr"))
