"""The background must not explain the scene: ground and sky are detected as two colours, and surfaces are
trained first.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest
import torch

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.model import CLEAR_OPACITY
from neilfpp_method.schedule import Stage, StagePosition
from neilfpp_method.settings.presets import preset
from neilfpp_method.settings.types import OptimizerConfig
from neilfpp_method.train.build import scene_facts
from neilfpp_method.train.loop import train
from neilfpp_method.train.optimizer import make_optimizer, set_rates, waiting_fields
from tests.data.make_capture import make_capture
from tests.data.skies import GROUND, SKY, make_sky_capture
from tests.scenes import sphere_model, tiny_config
from tests.train.small_runs import small_training, solved_light


def facts_of(root: Path):
    capture = load_capture(root)
    return scene_facts(capture, PixelDataset(capture, capture.train_views), tiny_config())


def test_the_kind_of_background_comes_from_the_images(tmp_path):
    even, sky = (
        facts_of(make_capture(tmp_path / "even", background=GROUND)),
        facts_of(make_sky_capture(tmp_path / "sky")),
    )
    assert (even.background, sky.background) == ("constant", "inverted_sphere")
    assert even.background_color == sky.background_color == (GROUND, GROUND, GROUND)


@pytest.mark.parametrize(("stage", "share", "moves"), [
    (Stage.SDF_INIT, 0.0, False),
    (Stage.SDF_INIT, 0.39, False),
    (Stage.SDF_INIT, 0.4, True),
    (Stage.MATERIAL_INIT, 0.0, True),
    (Stage.JOINT, 0.0, True),
])  # fmt: skip
def test_the_background_is_trained_after_surfaces_exist(stage, share, moves):
    model = sphere_model(background="inverted_sphere")
    config = OptimizerConfig(background_from=0.4)
    optimizer = make_optimizer(model, config)
    position = StagePosition(stage, step=round(100 * share), length=100)
    set_rates(optimizer, config, position, waiting_fields(model, config, position))
    rates = {group["name"]: group["lr"] for group in optimizer.param_groups}
    assert (rates.pop("background") > 0) == moves
    assert all(rate > 0 for rate in rates.values())


def test_the_background_is_trained_at_once_if_points_are_behind_the_scene(tmp_path):
    capture = load_capture(make_sky_capture(tmp_path / "sky", views=6, size=(48, 36)))
    pixels = PixelDataset(capture, capture.train_views)
    far_points = [
        scene_facts(dataclasses.replace(capture, scene_from=told_by), pixels, tiny_config()).far_points
        for told_by in ("points", "focus")
    ]
    assert far_points == [False, True]
    config = tiny_config()
    config = dataclasses.replace(config, optimizer=dataclasses.replace(config.optimizer, background_from=1.0))
    steps = dataclasses.replace(config.train, sdf_steps=3, material_steps=0, joint_steps=0)
    config = dataclasses.replace(config, train=steps)
    for far, name in ((False, "near"), (True, "far")):
        training = small_training(capture.root, tmp_path / name, config)
        training.model.facts = dataclasses.replace(training.model.facts, far_points=far)
        before = [p.detach().clone() for p in training.model.host.background.parameters()]
        train(training)
        after = training.model.host.background.parameters()
        assert any(not torch.equal(a, b) for a, b in zip(before, after, strict=True)) == far


def test_a_sphere_under_a_sky_gets_a_surface(tmp_path):
    """With the background settings of `fast`, and small networks."""
    config = tiny_config()
    fast = preset("fast").optimizer
    steps = dataclasses.replace(
        config.train, sdf_steps=300, material_steps=0, joint_steps=0, rays=256, checkpoint_every=1000
    )
    config = dataclasses.replace(config, optimizer=fast, train=steps)
    training = small_training(
        make_sky_capture(tmp_path / "sky", views=10, size=(48, 36)), tmp_path / "run", config
    )
    train(training)
    model = training.model.eval()
    capture = training.pixels.capture
    truth = PixelDataset(
        load_capture(make_capture(tmp_path / "truth", views=10, size=(48, 36), masks=True)), capture.views
    )
    with torch.no_grad():
        batch = truth.view(3)
        hits = model.host.render(batch.rays)
    on = batch.mask > 0.5
    assert hits.opacity[on].median() > 0.9
    assert hits.opacity[~on].median() < 0.1
    outward = torch.nn.functional.normalize(hits.position[on], dim=-1)
    assert (hits.normal[on] * outward).sum(-1).median() > 0.9


@pytest.mark.parametrize("background", ["inverted_sphere", "constant"])
def test_pixels_beyond_the_scene_are_remembered_as_its_light(tmp_path, background):
    """A constant background is a backdrop, or black if nothing is known: it is not light."""
    model = sphere_model(solved_light(tiny_config()), background=background).train()
    capture = load_capture(make_sky_capture(tmp_path / "sky"))
    batch = PixelDataset(capture, capture.views).sample(400)
    torch.manual_seed(1)
    solver = model.light_solver()
    solver.observe(model.step(batch, Stage.MATERIAL_INIT))
    if background == "constant":
        assert solver.sky is None
        return
    torch.manual_seed(1)  # the same samples along the same rays
    with torch.no_grad():
        clear = model.host.render(batch.rays).opacity < CLEAR_OPACITY
    assert 0 < clear.sum() < 400
    known = solver.sky.known()
    assert solver.sky.pixels.sum() == clear.sum()
    of_texels = known.log_radiance[0][known.weight > 0.5]
    off = of_texels[:, None] - torch.tensor([GROUND, SKY[0]]).log()
    assert off.abs().min() < 0.01, "a texel that shows nothing but ground, or but sky, has its radiance"
