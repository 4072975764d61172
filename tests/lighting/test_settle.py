"""Lamps that move: derivatives of what they bring, pieces that become one, and neighbours that stay two."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from torch.nn.functional import normalize

from neilfpp_method.config import LightFitConfig
from neilfpp_method.fields.lamps import LampPlaces
from neilfpp_method.lighting.candidates import FoundLamps
from neilfpp_method.lighting.memory import Observed
from neilfpp_method.lighting.objective import Target
from neilfpp_method.lighting.settle import settle_lamps
from neilfpp_method.lighting.transport import Transport, from_lamps, in_sight, lamp_kernel
from neilfpp_method.shading.brdf import GGX
from neilfpp_method.structures import Material
from tests.lighting.surfaces import half_room, material, points

RADIUS = 0.06
TRUE = FoundLamps(
    LampPlaces(torch.tensor([[0.5, -0.3, 0.6], [-0.6, 0.4, 0.5]]), torch.tensor([[0.0, 0.0, 0.0], [0.6, 0.0, -0.8]])),
    torch.tensor([[1.0, 0.8, 0.5], [0.4, 0.5, 0.7]]),
)


def photographed(lamps: FoundLamps) -> tuple[Observed, Material, Transport]:
    """Points under lamps and even light from everywhere."""
    seen, of = points(600), material(600)
    seen = dataclasses.replace(seen, position=4 * seen.position)
    even = torch.full((600, 3), 0.3)
    beside = Transport(torch.zeros(3, 600, 0), torch.stack((even, even, 0.1 * even)))
    carried = from_lamps(lamps.places, RADIUS, seen, of.roughness, GGX, None)
    image = Transport(carried.sources, beside.scene).outgoing(of, lamps.intensity)
    return dataclasses.replace(seen, pixel=image), of, beside


def settled(start: FoundLamps, true: FoundLamps) -> FoundLamps:
    seen, of, beside = photographed(true)
    unit = seen.pixel.median().item()
    return settle_lamps(start, RADIUS, beside, seen, Target(of, seen.pixel), GGX, None, "linear", unit, LightFitConfig())


def test_derivatives_by_place_and_axis():
    torch.manual_seed(0)
    seen = Observed(*(getattr(points(6), name).double() for name in ("position", "normal", "wo", "pixel")))
    places = (TRUE.places.position.double().requires_grad_(), TRUE.places.axis.double().requires_grad_())
    roughness = torch.full((6, 1), 0.4, dtype=torch.float64)
    sight = torch.rand(6, 2) < 0.7

    def kernel(position: torch.Tensor, axis: torch.Tensor) -> torch.Tensor:
        return lamp_kernel(LampPlaces(position, axis), RADIUS, sight, seen, roughness, GGX)

    assert torch.autograd.gradcheck(lambda position: kernel(position, places[1].detach()), places[0])
    # By an axis of zero, a bulb's, there is no derivative: which kind a lamp is does not change.
    turned = places[1].detach()[1:].repeat(2, 1).requires_grad_()
    assert torch.autograd.gradcheck(lambda axis: kernel(places[0].detach(), axis), turned)


def test_a_wall_hides_a_lamp():
    x = torch.zeros(1, 3)
    lamps = LampPlaces(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -3.0], [0.0, 0.0, -1.0]]), torch.zeros(3, 3))
    assert in_sight(lamps, RADIUS, x, half_room).tolist() == [[True, False, True]]


def test_a_lamp_in_pieces_becomes_one_where_it_is():
    true = FoundLamps(TRUE.places[:1], TRUE.intensity[:1])
    offsets = torch.tensor([[0.12, 0.0, 0.05], [-0.1, 0.15, 0.0], [0.0, -0.2, -0.15], [0.3, 0.3, 0.3]])
    pieces = FoundLamps(LampPlaces(true.places.position + offsets, torch.zeros(4, 3)), 0.4 * true.intensity.expand(4, 3))
    found = settled(pieces, true)
    assert len(found.intensity) == 1
    torch.testing.assert_close(found.places.position, true.places.position, rtol=0, atol=0.01)
    torch.testing.assert_close(found.intensity, true.intensity, rtol=0.03, atol=0)


def test_two_lamps_stay_two_and_come_to_where_they_are():
    torch.manual_seed(0)
    start = FoundLamps(
        LampPlaces(
            TRUE.places.position + 0.08 * torch.randn(2, 3),
            torch.stack((torch.zeros(3), normalize(TRUE.places.axis[1] + 0.3 * torch.randn(3), dim=0))),
        ),
        0.7 * TRUE.intensity,
    )
    found = settled(start, TRUE)
    torch.testing.assert_close(found.places.position, TRUE.places.position, rtol=0, atol=0.02)
    torch.testing.assert_close(found.places.axis, TRUE.places.axis, rtol=0, atol=0.1)
    torch.testing.assert_close(found.intensity, TRUE.intensity, rtol=0.1, atol=0)


@pytest.mark.parametrize("broken", ["no points", "no lamps", "a pixel that is no number"])
def test_where_there_is_nothing_to_go_by_lamps_stay(broken):
    seen, of, beside = photographed(TRUE)
    start = TRUE
    if broken == "no points":
        seen, of, beside = seen[:0], of[:0], beside[torch.arange(0)]
    elif broken == "no lamps":
        start = FoundLamps(TRUE.places[:0], TRUE.intensity[:0])
    else:
        seen.pixel[0] = torch.nan
    found = settle_lamps(start, RADIUS, beside, seen, Target(of, seen.pixel), GGX, None, "linear", 0.3, LightFitConfig())
    torch.testing.assert_close(found.places.position, start.places.position)
    torch.testing.assert_close(found.intensity, start.intensity)
