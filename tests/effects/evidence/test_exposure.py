"""Photographs of unequal exposure and white balance: gains are measured, decided on, learned, and divided
out.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.images import read_image, write_exr, write_png
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.effects.evidence.exposure import judge_gains, measure_exposures
from neilfpp_method.effects.plan import Plan
from neilfpp_method.effects.request import parse_effects
from neilfpp_method.effects.review import record_exposures
from neilfpp_method.evaluate.map_metrics import exposed_alike
from neilfpp_method.fields.exposure import at_mean_exposure
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, active_losses, weigh
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import preset
from neilfpp_method.shading.color import apply_response, linear_to_srgb, srgb_to_linear
from neilfpp_method.train.build import build_model, exposures_at_cloud, scene_facts
from tests.data.make_capture import make_capture, srgb
from tests.scenes import sphere_batch, tiny_config

VIEWS = 8
LOG_GAINS = np.random.default_rng(3).uniform(-0.5, 0.3, (VIEWS, 3))


def photographs(root: Path, hdr: bool, log_gains: np.ndarray):
    """The sphere; each view is multiplied by its own gain per channel."""
    capture = load_capture(make_capture(root, views=VIEWS, size=(64, 48), hdr=hdr, masks=True, test=None))
    dark = 0.4  # the sphere's radiance of up to 2.0 then stays in the range of a display
    for view, gain in zip(capture.views, np.exp(log_gains), strict=True):
        pixels = read_image(view.image).pixels
        if hdr:
            write_exr(view.image, {"RGB": (pixels * gain).astype(np.float32)})
        else:
            # Clipped values of the file are unknown, so they are darkened like the others.
            linear = srgb_to_linear(torch.from_numpy(pixels)).numpy()
            write_png(view.image, np.rint(255 * srgb(dark * linear * gain)).astype(np.uint8))
    return load_capture(root, test_every=0)


@pytest.mark.parametrize("hdr", [True, False])
def test_gains_of_photographs_are_recovered(tmp_path, hdr):
    capture = photographs(tmp_path / "sphere", hdr, LOG_GAINS)
    found = exposures_at_cloud(capture, PixelDataset(capture, capture.train_views))
    true = torch.from_numpy(LOG_GAINS - LOG_GAINS.mean(0)).float()
    torch.testing.assert_close(found.log_gain, true, atol=0.03, rtol=0.0)
    assert found.measured.favours(chosen=False)
    assert found.measured.value > 0.05


def test_photographs_of_equal_exposure_need_no_gains(tmp_path):
    capture = photographs(tmp_path / "sphere", True, np.zeros((VIEWS, 3)))
    pixels, plan = (
        PixelDataset(capture, capture.train_views),
        Plan.begin(parse_effects("auto"), preset("fast")),
    )
    found = exposures_at_cloud(capture, pixels)
    assert abs(found.measured.value) < 0.005
    record_exposures(plan, found)
    decision = plan.newest("exposure")
    assert (decision.on, decision.by) == (False, "files")
    assert plan.config_of_model.optimizer.exposure == 0.0
    config = changed(tiny_config(), {"optimizer.exposure": plan.config_of_model.optimizer.exposure})
    model = build_model(capture, scene_facts(capture, pixels, config), config)
    assert model.gains is None
    assert "exposure" not in model.parameter_groups()
    assert "exposure" not in active_losses(Stage.SDF_INIT, config)
    batch = sphere_batch()
    assert at_mean_exposure(model.gains, batch.color, batch.view, "linear") is batch.color


def test_without_a_cloud_nothing_is_measured(tmp_path):
    capture = dataclasses.replace(load_capture(make_capture(tmp_path / "sphere")), point_cloud=None)
    plan = Plan.begin(parse_effects("auto"), preset("fast"))
    record_exposures(plan, exposures_at_cloud(capture, PixelDataset(capture, capture.train_views)))
    assert not plan.is_on("exposure")
    asked = Plan.begin(parse_effects("+exposure"), preset("paper-mlp"))
    record_exposures(asked, None)
    assert asked.is_on("exposure")
    assert asked.config_of_model.optimizer.exposure > 0


@pytest.mark.parametrize(("all_alike", "on"), [(True, True), (False, False)])
def test_a_shiny_table_is_not_an_exposure(all_alike, on):
    """A gain that applies to the table, but not to other surfaces, is a reflection of the table."""
    generator = torch.Generator().manual_seed(0)
    place = torch.randn(300, 1, 3, generator=generator)
    factor = torch.randn(12, 3, generator=generator) * 0.3
    table = torch.arange(300) < 240
    noise = 0.05 * torch.randn(300, 12, 3, generator=generator)
    seen = place + torch.where(table[:, None, None] | torch.tensor(all_alike), factor, 0.0) + noise
    tilt = torch.randn(300, 3, generator=generator) * 0.1
    facing = torch.where(table[:, None], torch.tensor([0.0, 0.0, 1.0]), torch.tensor([0.0, 1.0, 0.0]))
    found = judge_gains(seen, torch.nn.functional.normalize(facing + tilt, dim=-1))
    assert found.samples in (60, 240)
    assert found.favours(chosen=False) is on


def test_a_cloud_with_a_single_orientation_decides_nothing():
    seen = torch.randn(12, 3).expand(300, 12, 3)
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(300, 3)
    assert judge_gains(seen, up).favours(chosen=False) is None


def test_too_few_points_decide_nothing(tmp_path):
    capture = load_capture(make_capture(tmp_path / "sphere"))
    pixels = PixelDataset(capture, capture.train_views)
    sphere = build_model(capture, scene_facts(capture, pixels, tiny_config()), tiny_config()).host
    cloud_behind = dataclasses.replace(sphere.points, position=sphere.points.position + 100.0)
    found = measure_exposures(pixels, cloud_behind)
    assert found.measured.favours(chosen=False) is None
    assert not found.log_gain.any()


def exposed_model(response: str, log_gains: torch.Tensor, start: torch.Tensor | None = None) -> NeilfModel:
    """An untrained sphere whose photographs have gains."""
    torch.manual_seed(0)
    config = changed(tiny_config(), {"optimizer.exposure": 1e-2})
    facts = SceneFacts(
        response,
        0.2,
        2.0 if response == "srgb" else 3.0,
        "constant",
        log_gains=tuple((log_gains if start is None else start).flatten().tolist()),
    )
    return NeilfModel(VolSdfHost(config, facts), config, facts)


@pytest.mark.parametrize("response", ["linear", "srgb"])
def test_training_finds_gains_from_an_initial_value_of_zero(response):
    true = torch.tensor([[0.3, 0.0, -0.2], [-0.3, 0.1, 0.2], [0.0, -0.1, 0.0]])
    model = exposed_model(response, true, start=torch.zeros(3, 3))
    batch = sphere_batch(240)
    batch = dataclasses.replace(batch, view=torch.arange(240) % 3)
    with torch.no_grad():
        radiance = model.host.eval().render(batch.rays).color
    batch = dataclasses.replace(batch, color=apply_response(radiance * true.exp()[batch.view], response))
    model.host.train()
    optimizer = torch.optim.Adam(model.parameter_groups()["exposure"], lr=1e-2)
    weights = {"volume": 2.0, "exposure": active_losses(Stage.SDF_INIT, model.config)["exposure"]}
    for _ in range(120):
        optimizer.zero_grad()
        terms = model.losses(batch, Stage.SDF_INIT)
        weigh({name: terms[name] for name in weights}, weights).loss.backward()
        optimizer.step()
    found = model.gains.logarithms().detach()
    # The prior reduces the gains slightly, and the photographs are compared by L1.
    torch.testing.assert_close(found, true, atol=0.03, rtol=0.0)
    torch.testing.assert_close(found.mean(0), torch.zeros(3), atol=1e-6, rtol=0.0)


@pytest.mark.parametrize("response", ["linear", "srgb"])
def test_shading_and_light_use_the_mean_exposure(response):
    gains = torch.tensor([[0.4, 0.0, -0.3], [-0.4, 0.0, 0.3]])
    model = exposed_model(response, gains)
    model.config = dataclasses.replace(
        model.config, shading=dataclasses.replace(model.config.shading, hit_share=0.2)
    )
    radiance = torch.full((400, 3), 0.25)
    batch = dataclasses.replace(sphere_batch(400), view=torch.arange(400) % 2)
    batch = dataclasses.replace(batch, color=apply_response(radiance * gains.exp()[batch.view], response))
    seen = model.step(batch, Stage.JOINT).surface.pixel
    assert len(seen) > 100
    common = apply_response(torch.tensor(0.25), response)
    torch.testing.assert_close(seen, common.expand_as(seen), atol=1e-5, rtol=0.0)


def test_gains_are_in_checkpoints_and_train_with_R():
    model = exposed_model("linear", torch.tensor([[0.2] * 3, [-0.2] * 3]))
    assert {"gains.log_gain", "gains.start"} <= set(model.state_dict())
    trained = {stage: "exposure" in model.stages[stage].trains for stage in Stage}
    assert trained == {Stage.SDF_INIT: True, Stage.MATERIAL_INIT: False, Stage.JOINT: True}


@pytest.mark.parametrize("response", ["linear", "srgb"])
def test_a_new_view_is_compared_at_its_own_exposure(response):
    generator = np.random.default_rng(0)
    estimate = generator.uniform(0.05, 0.6, (6, 5, 3)).astype(np.float32)
    gain = np.array([0.7, 1.0, 1.3], np.float32)
    image = estimate * gain
    if response == "srgb":
        image = linear_to_srgb(torch.from_numpy(image)).numpy()
        image[0] = 1.0  # clipped: does not determine the gain
    estimate[1, :2] = 1e5  # a false highlight does not determine it either
    mask = np.ones((6, 5), bool)
    np.testing.assert_allclose(exposed_alike(estimate, image, mask, response), estimate * gain, rtol=1e-5)
    assert np.array_equal(exposed_alike(estimate, image, mask & False, response), estimate)
