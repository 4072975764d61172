"""A second look at a ball whose radiance is known in closed form: under light that is the same from everywhere."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch.nn.functional import normalize

from neilfpp_method import losses
from neilfpp_method.facts import SceneFacts
from neilfpp_method.lighting.memory import Observed
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, active_losses
from neilfpp_method.second_view import SHARE, lobe_difference, second_view
from neilfpp_method.shading.albedo import directional_albedo
from neilfpp_method.shading.brdf import GGX, LOBES
from neilfpp_method.structures import Material, RayBatch, SurfaceHits
from tests.scenes import meet_ball, sphere_batch, tiny_config

LIGHT, ROUGHNESS = 0.7, 0.35


def material_of(points: int, base_color: float = 0.4, roughness: float = ROUGHNESS, metallic: float = 0.2) -> Material:
    one = torch.ones(points, 1)
    return Material(base_color * one.expand(-1, 3), roughness * one, metallic * one)


class Ball:
    """A host: a ball of radius 0.6 about the origin, of one material, under light of `LIGHT` from everywhere."""

    def __init__(self, concentration: float = 1.0) -> None:
        self.concentration, self.rays = concentration, 0

    def render(self, rays: RayBatch) -> SurfaceHits:
        self.rays += len(rays)
        position, met = meet_ball(rays, 0.6)
        normal = normalize(position, dim=-1)
        color = LIGHT * directional_albedo(material_of(len(rays)), normal, -rays.directions, GGX)
        return SurfaceHits(color, position, normal, met, met * self.concentration)


def points_seen(count: int = 2000) -> Observed:
    torch.manual_seed(0)
    normal = normalize(torch.randn(count, 3), dim=-1)
    wo = normalize(normal + 0.8 * torch.randn(count, 3), dim=-1)
    wo = torch.where((wo * normal).sum(-1, keepdim=True) > 0.1, wo, normal)
    pixel = LIGHT * directional_albedo(material_of(count), normal, wo, GGX)
    return Observed(0.6 * normal, normal, wo, pixel)


def test_a_second_view_is_what_the_host_sends_another_way_from_the_same_point():
    seen, host = points_seen(), Ball()
    second = second_view(host, seen, offset=0.02, hit_share=0.8)
    assert 0.2 * SHARE * len(seen) < len(second) <= host.rays < SHARE * len(seen)
    normal = seen.normal[second.row]
    assert ((second.wo * normal).sum(-1) > 0).all()
    expected = LIGHT * directional_albedo(material_of(len(second)), normal, second.wo, GGX)
    torch.testing.assert_close(second.radiance, expected, rtol=1e-3, atol=1e-3)
    cameras = {tuple(row) for row in seen.wo.tolist()}
    assert all(tuple(row) in cameras for row in second.wo.tolist())


def test_rays_that_meet_fog_are_no_second_views():
    assert len(second_view(Ball(concentration=0.5), points_seen(), offset=0.02, hit_share=0.8)) == 0


def error(material: dict[str, float]) -> float:
    """The loss for a ball that is taken to be of another material."""
    seen = points_seen()
    second = second_view(Ball(), seen, offset=0.02, hit_share=0.8)
    seen, found = seen[second.row], material_of(len(second), **material)
    first, other = (
        LIGHT * directional_albedo(found, seen.normal, wo, GGX) - LIGHT * found.base_color * (1 - found.metallic)
        for wo in (seen.wo, second.wo)
    )
    weight = lobe_difference(GGX, found.roughness, seen.normal, seen.wo, second.wo)
    return losses.specular(first - other, seen.pixel - second.radiance, weight).mean().item()


def test_the_diffuse_part_takes_itself_out_and_highlights_do_not():
    # A dielectric's highlight does not know its base colour, and neither does the loss; a metal's does.
    assert error({}) < 1e-3
    assert error({"roughness": 0.9}) > 10 * error({})
    assert error({"metallic": 0.9}) > 10 * error({})
    dielectric = [error({"metallic": 0.0, "base_color": base}) for base in (0.1, 0.9)]
    assert dielectric[0] == pytest.approx(dielectric[1], rel=1e-4)


@pytest.mark.parametrize("lobe", list(LOBES))
def test_lobes_differ_by_roughness_and_angle(lobe):
    n = torch.tensor([[0.0, 0.0, 1.0]]).expand(3, 3)
    wo = normalize(torch.tensor([[0.5, 0.0, 1.0]]), dim=-1).expand(3, 3)
    mirror = wo * torch.tensor([-1.0, -1.0, 1.0])
    # The mirror direction of the mirror direction is where wo is: no difference. A little and a lot beside it:
    other = torch.stack((wo[0], normalize(wo[0] + torch.tensor([0.1, 0.0, 0.0]), dim=0), mirror[0]))
    smooth = lobe_difference(LOBES[lobe], torch.full((3, 1), 0.2), n, wo, other)[:, 0]
    rough = lobe_difference(LOBES[lobe], torch.full((3, 1), 0.9), n, wo, other)[:, 0]
    assert smooth[0].item() == pytest.approx(0.0, abs=1e-3)
    assert smooth[0] < smooth[1] < smooth[2] <= 1
    assert (rough[1:] < smooth[1:]).all()
    assert torch.isfinite(lobe_difference(LOBES[lobe], torch.zeros(3, 1), n, wo, -mirror)).all()


def ball_model(**weights: float) -> NeilfModel:
    config = tiny_config()
    config = dataclasses.replace(
        config,
        light=dataclasses.replace(config.light, kind="distant", map="known.exr"),
        inter_reflection=dataclasses.replace(config.inter_reflection, mode="off"),
        loss=dataclasses.replace(config.loss, **weights),
    )
    torch.manual_seed(0)
    return NeilfModel(Ball(), config, SceneFacts("linear", 0.2, 3.0, "constant"))


def test_a_step_pays_for_it_where_it_is_on_alone():
    batch = sphere_batch(256)
    off = ball_model()
    assert "specular" not in off.losses(batch, Stage.MATERIAL_INIT)
    assert off.host.rays == len(batch)
    on = ball_model(specular=1.0)
    assert "specular" in active_losses(Stage.JOINT, on.config)
    term = on.losses(batch, Stage.MATERIAL_INIT)["specular"]
    assert len(batch) < on.host.rays <= (1 + SHARE) * len(batch)
    term.mean().backward()
    assert any(p.grad is not None and p.grad.abs().max() > 0 for p in on.brdf.parameters())


def test_energy_is_asked_for_where_it_is_on_alone():
    on = ball_model(energy=1.0)
    term = on.losses(sphere_batch(), Stage.MATERIAL_INIT)["energy"]
    assert term.mean().item() == 0.0  # the material starts dark
    assert "energy" not in ball_model().losses(sphere_batch(), Stage.MATERIAL_INIT)
    bright = losses.energy(torch.tensor([[1.3, 0.9, 1.0]]))
    assert bright.values[0].tolist() == pytest.approx([0.3, 0.0, 0.0])
