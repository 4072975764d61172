"""Hosts, batches and loops in the forms in which other projects have them."""

from __future__ import annotations

import collections
import dataclasses
import io
import logging

import pytest
import torch

from neilfpp_method.attach import attach_neilf, pixel_batch
from neilfpp_method.errors import UserError
from neilfpp_method.hosts.batches import check_batch, check_points, check_rows, check_step
from neilfpp_method.schedule import Stage
from neilfpp_method.structures import RayBatch
from tests.hosts.balls import Ball, BallHost, ball_rays
from tests.scenes import tiny_config
from tests.test_attach import pixels
from tests.train.small_runs import solved_light


class TrainedBall(BallHost):
    """A ball that is trained together with the material."""

    groups = "geometry"

    def parameter_groups(self):
        return {self.groups: list(self.parameters())}


# ------------------------------------------------------------------------------------ hosts without gradients


@pytest.mark.parametrize("freeze", [torch.no_grad(), lambda ball: ball.requires_grad_(False)])
def test_a_host_without_gradients_trains_material_and_light_in_the_joint_stage(freeze, caplog):
    neilf = attach_neilf(freeze(Ball()), tiny_config())
    optimizer = torch.optim.Adam(neilf.parameters(), lr=1e-2)
    before = [p.detach().clone() for p in neilf.parameters()]
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            optimizer.zero_grad()
            neilf.losses(pixels(), Stage.JOINT).loss.backward()
            optimizer.step()
    assert not all(torch.equal(a, b) for a, b in zip(before, neilf.parameters(), strict=True))
    (said,) = (r.getMessage() for r in caplog.records if "no gradient" in r.getMessage())
    assert "only material and light are trained; to train the host, render without torch.no_grad" in said


def test_a_host_that_offers_parameters_must_have_gradients():
    neilf = attach_neilf(
        TrainedBall(lambda rays, outputs: {"color": outputs["color"].detach()}), tiny_config()
    )
    with pytest.raises(UserError, match="TrainedBall: its color has no gradient to the host's parameters"):
        neilf.losses(pixels(), Stage.JOINT)


# -------------------------------------------------------------------------------------- forms of hosts


Ours = collections.namedtuple("Ours", "position normal rgb")
FORMS = {
    "tuple": lambda c, p, n: (c, p, n),
    "dictionary": lambda c, p, n: {"rgb": c, "position": p, "normals": 3.0 * n},
    "named": lambda c, p, n: Ours(p, n, c),
}


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
@pytest.mark.parametrize("by", ["render", "function"])
def test_hosts_return_any_form_that_is_read(form, by):
    ball = Ball()

    class Renderer:
        def render(self, rays):
            return form(*ball(rays.origins, rays.directions))

    host = Renderer() if by == "render" else lambda origins, directions: form(*ball(origins, directions))
    rays = ball_rays(32)
    torch.manual_seed(0)
    given = attach_neilf(host, tiny_config()).model.host.render(rays)
    expected = attach_neilf(ball, tiny_config()).model.host.render(rays)
    hit = expected.is_hit(0.8)
    assert hit.any()
    assert torch.equal(given.is_hit(0.8), hit)
    for name in ("color", "position", "normal"):
        torch.testing.assert_close(getattr(given, name)[hit], getattr(expected, name)[hit])


class TwoArguments:
    def render(self, origins, directions):
        raise NotImplementedError


class NearAndFar(torch.nn.Module):
    def forward(self, rays, near, far):
        raise NotImplementedError


class Objects:
    def render(self, rays):
        return self


@pytest.mark.parametrize(
    ("host", "message"),
    [
        (TwoArguments(), r"TwoArguments.render\(origins, directions\) is called with one RayBatch"),
        (NearAndFar(), r"NearAndFar\(rays, near, far\) is called with two tensors, origins and directions"),
        (BallHost, "BallHost is a class, not a host; give an instance of BallHost"),
    ],
)
def test_a_host_that_takes_other_arguments_is_refused_before_training(host, message):
    with pytest.raises(UserError, match=message):
        attach_neilf(host, tiny_config())


def test_a_rendered_object_of_another_class_is_named():
    neilf = attach_neilf(Objects(), tiny_config())
    with pytest.raises(UserError, match="Objects: returns a Objects; return color, position and normal"):
        neilf.losses(pixels(), Stage.MATERIAL_INIT)


def test_groups_without_a_learning_rate_are_refused():
    host = TrainedBall()
    host.groups = "decoder"
    with pytest.raises(UserError, match=r"unknown field 'decoder'; .* geometry, beta, radiance, background"):
        attach_neilf(host, tiny_config())
    host.parameter_groups = lambda: [{"params": list(host.parameters())}]
    with pytest.raises(UserError, match=r"TrainedBall.parameter_groups\(\) returns a list"):
        attach_neilf(host, tiny_config())


def test_a_scene_in_other_units_is_an_error():
    by, ball = torch.tensor([100.0, 50.0, 3.0]), Ball()

    def far(origins, directions):
        color, position, normal = ball((origins - by) / 40.0, directions)
        return color, 40.0 * position + by, normal

    batch = pixels()
    batch = dataclasses.replace(batch, origins=40.0 * batch.origins + by)
    with pytest.raises(UserError, match=r"half of its hits are .* or more from the origin; move and scale"):
        attach_neilf(far, tiny_config()).losses(batch, Stage.MATERIAL_INIT)


def with_background(origins, directions):
    """A ball in front of a distant sphere that counts as a surface."""
    color, position, normal = Ball()(origins, directions)
    hit = normal.norm(dim=-1, keepdim=True) > 0.5
    return (
        torch.where(hit, color, 0.3),
        torch.where(hit, position, origins + 50.0 * directions),
        torch.where(hit, normal, -directions),
    )


def test_a_distant_background_that_counts_as_a_surface_is_reported(caplog):
    with caplog.at_level(logging.WARNING):
        attach_neilf(with_background, tiny_config()).losses(pixels(spread=0.5), Stage.MATERIAL_INIT)
    assert any("of its hits are 10 or more from the origin" in r.getMessage() for r in caplog.records)
    with pytest.raises(UserError, match="distant background, give its rays a concentration of 0"):
        attach_neilf(with_background, tiny_config()).losses(pixels(spread=1.2), Stage.MATERIAL_INIT)


class AutogradNormals(Ball):
    """Computes its normals by autograd, as density and distance fields do."""

    def forward(self, origins, directions):
        color, position, normal = super().forward(origins, directions)
        with torch.enable_grad():
            x = (origins + (position - origins)).detach().requires_grad_(True)
            slope = torch.autograd.grad(x.norm(dim=-1).sum(), x)[0]
        return color, position, torch.where(normal.norm(dim=-1, keepdim=True) > 0.5, slope, 0.0)


def test_maps_render_in_inference_mode():
    """Maps can be rendered in it although hosts need autograd; what is attached in it can be trained."""
    host, rays = AutogradNormals(), ball_rays(16)
    with torch.inference_mode():
        neilf = attach_neilf(host, tiny_config())
    neilf.losses(pixels(), Stage.JOINT).loss.backward()
    neilf.eval()
    with torch.inference_mode():
        maps = neilf.maps(RayBatch(rays.origins + 0.0, rays.directions + 0.0))
    assert maps.normal.norm(dim=-1).max() > 0.5
    assert not maps.base_color.requires_grad


def test_a_module_with_a_proxy_changes_its_precision_during_training():
    host = Ball()
    neilf = attach_neilf(host, solved_light(tiny_config()))
    for _ in range(3):
        neilf.losses(pixels(), Stage.MATERIAL_INIT)
    assert neilf.proxy.scene_light(torch.zeros(1, 3), torch.ones(1, 1, 3)).distance.dtype == torch.float32
    neilf.double(), host.double()
    batch = pixels()
    floats = {f.name: getattr(batch, f.name) for f in dataclasses.fields(batch)}
    batch = dataclasses.replace(
        batch, **{name: t.double() for name, t in floats.items() if t.is_floating_point()}
    )
    for _ in range(3):
        total = neilf.losses(batch, Stage.MATERIAL_INIT)
        total.loss.backward()
    assert total.loss.dtype == torch.float64


def test_a_checkpoint_of_another_precision_is_read():
    trained = attach_neilf(Ball(), solved_light(tiny_config()))
    for _ in range(3):
        trained.losses(pixels(), Stage.MATERIAL_INIT)
    state = trained.state_dict()
    fresh = attach_neilf(Ball().double(), solved_light(tiny_config())).double()
    fresh.load_state_dict(state)
    assert fresh.proxy._pending
    assert {pending.rays.origins.dtype for pending in fresh.proxy._pending} == {torch.float64}
    fresh.proxy.refresh()


# -------------------------------------------------------------------------------------- forms of batches


def test_a_mask_may_be_boolean_and_must_be_between_0_and_1():
    rays, color = ball_rays(4), torch.rand(4, 3)
    mask = torch.tensor([True, False, True, True])
    assert torch.equal(pixel_batch(rays.origins, rays.directions, color, mask).mask, mask.float())
    neilf = attach_neilf(Ball(), tiny_config())
    batch = pixel_batch(rays.origins, rays.directions, color, 255.0 * mask)
    with pytest.raises(UserError, match="mask is between 0 and 255; give 1 on the object and 0 off it"):
        neilf.losses(batch, Stage.MATERIAL_INIT)


def test_arrays_and_tuples_are_named():
    rays, neilf = ball_rays(4), attach_neilf(Ball(), tiny_config())
    with pytest.raises(UserError, match=r"origins of the batch is a ndarray; give a tensor"):
        check_rows("origins", rays.origins.numpy(), 4, 3)
    with pytest.raises(UserError, match=r"the batch is a tuple; make one with attach.pixel_batch"):
        check_batch((rays.origins, rays.directions))
    for step in (None, float("nan"), [3]):
        with pytest.raises(UserError, match=r"the step is .*; give the index of the step"):
            check_step(step)
    with pytest.raises(UserError, match=r"x is a list; give a tensor"):
        check_points("x", [[0.0, 0.0, 1.0]])
    with pytest.raises(
        UserError, match=r"x is torch.float64, material and light torch.float32; give x.float"
    ):
        neilf.materials(torch.zeros(1, 3).double())


def test_a_batch_without_rays_says_nothing(caplog):
    neilf = attach_neilf(Ball(), tiny_config())
    rays = RayBatch(torch.zeros(0, 3), torch.zeros(0, 3))
    with caplog.at_level(logging.WARNING):
        caplog.clear()
        neilf.losses(pixel_batch(rays.origins, rays.directions, torch.zeros(0, 3)), Stage.MATERIAL_INIT)
        neilf.health()
    assert not caplog.records


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_material_in_half_precision_is_refused(dtype):
    rays = ball_rays(4)
    batch = pixel_batch(rays.origins.to(dtype), rays.directions.to(dtype), torch.rand(4, 3).to(dtype))
    with pytest.raises(UserError, match=r"too coarse for positions; convert them with neilf.float"):
        attach_neilf(Ball(), tiny_config()).to(dtype).losses(batch, Stage.MATERIAL_INIT)


def test_an_attached_module_can_be_pickled_with_its_host():
    neilf = attach_neilf(Ball(), tiny_config())
    file = io.BytesIO()
    torch.save(neilf, file)
    file.seek(0)
    loaded = torch.load(file, weights_only=False)
    results = []
    for each in (neilf, loaded):
        torch.manual_seed(0)
        results.append(each.losses(pixels(), Stage.MATERIAL_INIT).loss)
    assert torch.equal(*results)


def test_the_moving_average_of_a_scene_contains_its_host():
    scene = torch.nn.ModuleDict({"host": Ball()})
    scene["neilf"] = attach_neilf(scene["host"], tiny_config())
    average = torch.optim.swa_utils.AveragedModel(scene, avg_fn=lambda mean, new, count: new)
    with torch.no_grad():
        scene["host"].radius.fill_(0.4)
    average.update_parameters(scene)  # the first call copies, the second averages
    average.update_parameters(scene)
    rays = ball_rays(8)
    depths = [each["neilf"].maps(rays).depth for each in (scene, average.module)]
    assert torch.equal(*depths)
