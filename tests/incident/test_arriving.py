"""Incident light at a surface point: the scene occludes the light, and lamps have their own rays."""

from __future__ import annotations

import math

import torch
from torch.nn.functional import normalize

from neilfpp_method.fields.lamps import Lamps
from neilfpp_method.incident import Sources, arriving, incident_radiance
from neilfpp_method.structures import IncidentSamples, SceneLight, Source

WALL, SKY = 0.3, 2.0
POINT = torch.zeros(1, 3)


class Sky:
    """A light that is brighter towards +z and records the directions that it is evaluated for."""

    def __init__(self) -> None:
        self.asked: list[torch.Tensor] = []

    def radiance(self, x: torch.Tensor, wi: torch.Tensor) -> torch.Tensor:
        self.asked.append(wi.reshape(-1, 3))
        return SKY * (1.5 + wi[..., 2:]).expand(wi.shape)

    def technique(self, normal: torch.Tensor) -> None:
        return None


def wall(x: torch.Tensor, wi: torch.Tensor) -> SceneLight:
    """All directions with x > 0 hit a wall at distance 1 that sends `WALL`."""
    hit = wi[..., 0] > 0
    radiance = torch.where(hit[..., None], WALL, 0.0).expand(wi.shape)
    return SceneLight(hit, radiance, torch.where(hit, 1.0, math.inf))


def directions(points: int, count: int) -> torch.Tensor:
    return normalize(torch.randn(points, count, 3, generator=torch.Generator().manual_seed(0)), dim=-1)


def even(wi: torch.Tensor) -> IncidentSamples:
    return IncidentSamples(wi, torch.full(wi.shape[:2], 1 / (4 * math.pi)))


def lamps(*positions: tuple[float, float, float]) -> Lamps:
    lit = Lamps(4, 0.05)
    lit.place(torch.tensor(positions).reshape(-1, 3), torch.ones(len(positions), 3))
    return lit


def test_the_light_is_evaluated_only_in_unoccluded_directions():
    wi, sky = directions(3, 50), Sky()
    incident = arriving(Sources(sky, lamps(), wall), torch.zeros(3, 3), even(wi))
    expected = torch.where(wi[..., :1] > 0, torch.full_like(wi, WALL), Sky().radiance(None, wi))
    torch.testing.assert_close(incident.radiance, expected)
    torch.testing.assert_close(incident.source, (wi[..., 0] > 0).long() * int(Source.SCENE))
    assert (torch.cat(sky.asked)[:, 0] <= 0).all()


def test_without_a_scene_no_direction_is_occluded():
    wi = directions(3, 50)
    incident = arriving(Sources(Sky(), lamps(), None), torch.zeros(3, 3), even(wi))
    torch.testing.assert_close(incident.radiance, Sky().radiance(None, wi))
    assert (incident.source == Source.LIGHT).all()


def test_weights_are_the_solid_angles_of_directions_and_lamps():
    wi = directions(1, 50)
    incident = arriving(Sources(Sky(), lamps((0.0, 0.0, 2.0)), None), POINT, even(wi))
    assert math.isclose(incident.weight[0, :50].sum().item(), 4 * math.pi, rel_tol=1e-6)
    assert math.isclose(incident.weight[0, 50].item(), math.pi * 0.05**2 / 4, rel_tol=1e-5)
    # Radiance times solid angle is intensity over the squared distance.
    torch.testing.assert_close(incident.radiance[0, 50] * incident.weight[0, 50], torch.full((3,), 1 / 4))


def test_a_wall_occludes_only_the_lamp_behind_it():
    before, behind, aside = (0.5, 0.0, 0.0), (1.5, 0.0, 0.0), (-1.5, 0.0, 0.0)
    incident = arriving(Sources(Sky(), lamps(before, behind, aside), wall), POINT, even(directions(1, 8)))
    assert incident.source[0, 8:].tolist() == [Source.LAMPS, Source.LAMPS + 1, Source.LAMPS + 2]
    assert (incident.radiance[0, 8:].sum(-1) > 0).tolist() == [True, False, True]


def test_radiance_along_a_direction_includes_lamps_that_it_hits():
    sources = Sources(Sky(), lamps((0.5, 0.0, 0.0), (-1.5, 0.0, 0.0), (1.5, 0.0, 0.0)), wall)
    towards, away = torch.tensor([[[1.0, 0.0, 0.0]]]), torch.tensor([[[-1.0, 0.0, 0.0]]])
    lamp = sources.lamps.radiance()[0]
    torch.testing.assert_close(incident_radiance(sources, POINT, towards)[0, 0], WALL + lamp)
    torch.testing.assert_close(incident_radiance(sources, POINT, away)[0, 0], 1.5 * SKY + lamp)
