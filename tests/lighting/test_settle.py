"""Refinement of lamps: derivatives of their contributions, candidates that merge into one lamp, and
neighbouring lamps that stay separate.
"""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from torch.nn.functional import normalize

from neilfpp_method.fields.lamps import LampPlaces
from neilfpp_method.lighting.candidates import FoundLamps
from neilfpp_method.lighting.fit_points import FitPoints
from neilfpp_method.lighting.lamp_transport import from_lamps, in_sight, lamp_kernel
from neilfpp_method.lighting.objective import Objective
from neilfpp_method.lighting.settle import settle_lamps
from neilfpp_method.lighting.transport import Transport
from neilfpp_method.shading.brdf import GGX
from neilfpp_method.structures import Material, Observed
from tests.lighting.surfaces import half_room, material, patches, points

RADIUS = 0.06
STEPS = 100
TRUE = FoundLamps(
    LampPlaces(
        torch.tensor([[0.5, -0.3, 0.6], [-0.6, 0.4, 0.5]]), torch.tensor([[0.0, 0.0, 0.0], [0.6, 0.0, -0.8]])
    ),
    torch.tensor([[1.0, 0.8, 0.5], [0.4, 0.5, 0.7]]),
)
WHITE = Material(torch.ones(600, 3), torch.ones(600, 1), torch.zeros(600, 1))


def photographed(lamps: FoundLamps, speckled: bool) -> tuple[Observed, Material, Transport]:
    """Points under lamps and an even light from all directions."""
    seen = points(600)
    seen = dataclasses.replace(seen, position=4 * seen.position)
    of = material(600) if speckled else patches(seen.position)
    even = torch.full((600, 3), 0.3)
    beside = Transport(torch.zeros(3, 600, 0), torch.stack((even, even, 0.1 * even)))
    carried = from_lamps(lamps.places, RADIUS, seen, of.roughness, GGX, None)
    image = Transport(carried.sources, beside.scene).outgoing(of, lamps.intensity)
    return dataclasses.replace(seen, pixel=image), of, beside


def settled(start: FoundLamps, true: FoundLamps, base_color_known: bool) -> FoundLamps:
    seen, of, beside = photographed(true, speckled=base_color_known)
    objective = Objective("linear", seen.pixel.median().item(), STEPS, base_color_known)
    return settle_lamps(start, RADIUS, beside, FitPoints(seen, of, GGX, None), objective)


def test_derivatives_by_place_and_axis():
    torch.manual_seed(0)
    seen = Observed(*(getattr(points(6), name).double() for name in ("position", "normal", "wo", "pixel")))
    places = (TRUE.places.position.double().requires_grad_(), TRUE.places.axis.double().requires_grad_())
    roughness = torch.full((6, 1), 0.4, dtype=torch.float64)
    sight = torch.rand(6, 2) < 0.7

    def kernel(position: torch.Tensor, axis: torch.Tensor) -> torch.Tensor:
        return lamp_kernel(LampPlaces(position, axis), RADIUS, sight, seen, roughness, GGX)

    assert torch.autograd.gradcheck(lambda position: kernel(position, places[1].detach()), places[0])
    # The zero axis of a bulb has no derivative, because the kind of a lamp does not change.
    turned = places[1].detach()[1:].repeat(2, 1).requires_grad_()
    assert torch.autograd.gradcheck(lambda axis: kernel(places[0].detach(), axis), turned)


def test_a_wall_occludes_a_lamp():
    x = torch.zeros(1, 3)
    lamps = LampPlaces(torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -3.0], [0.0, 0.0, -1.0]]), torch.zeros(3, 3))
    assert in_sight(lamps, RADIUS, x, half_room).tolist() == [[True, False, True]]


@pytest.mark.parametrize(("base_color_known", "as_tinted"), [(True, 0.03), (False, 0.06)])
def test_candidates_around_a_lamp_become_one_lamp_at_its_position(base_color_known, as_tinted):
    """If the base colour is unknown, a light close to white is preferred: a part of the lamp's tint is
    assigned to the surfaces.
    """
    true = FoundLamps(TRUE.places[:1], TRUE.intensity[:1])
    offsets = torch.tensor([[0.12, 0.0, 0.05], [-0.1, 0.15, 0.0], [0.0, -0.2, -0.15], [0.3, 0.3, 0.3]])
    candidates = FoundLamps(
        LampPlaces(true.places.position + offsets, torch.zeros(4, 3)), 0.4 * true.intensity.expand(4, 3)
    )
    found = settled(candidates, true, base_color_known)
    assert len(found.intensity) == 1
    torch.testing.assert_close(found.places.position, true.places.position, rtol=0, atol=0.01)
    torch.testing.assert_close(found.intensity.sum(), true.intensity.sum(), rtol=0.03, atol=0)
    torch.testing.assert_close(found.intensity, true.intensity, rtol=as_tinted, atol=0)


@pytest.mark.parametrize("base_color_known", [True, False])
def test_two_lamps_stay_separate_and_move_to_their_positions(base_color_known):
    torch.manual_seed(0)
    start = FoundLamps(
        LampPlaces(
            TRUE.places.position + 0.08 * torch.randn(2, 3),
            torch.stack((torch.zeros(3), normalize(TRUE.places.axis[1] + 0.3 * torch.randn(3), dim=0))),
        ),
        0.7 * TRUE.intensity,
    )
    found = settled(start, TRUE, base_color_known)
    torch.testing.assert_close(found.places.position, TRUE.places.position, rtol=0, atol=0.02)
    torch.testing.assert_close(found.places.axis, TRUE.places.axis, rtol=0, atol=0.1)
    torch.testing.assert_close(found.intensity, TRUE.intensity, rtol=0.1, atol=0)


# `test_two_lamps_stay_separate_and_move_to_their_positions` also starts with lamps of the right kinds.
@pytest.mark.parametrize(
    ("number", "start"),
    [
        pytest.param(0, TRUE.places.axis[1], id="a bulb from a panel"),
        pytest.param(1, TRUE.places.axis[0], id="a panel from a bulb"),
        pytest.param(0, TRUE.places.axis[0], id="a bulb from a bulb", marks=pytest.mark.slow),
        pytest.param(1, TRUE.places.axis[1], id="a panel from a panel", marks=pytest.mark.slow),
    ],
)
def test_a_lamp_is_of_the_kind_that_explains_the_points(number, start):
    row = slice(number, number + 1)
    true = FoundLamps(TRUE.places[row], TRUE.intensity[row])
    found = settled(
        FoundLamps(LampPlaces(true.places.position + 0.05, start[None]), true.intensity),
        true,
        base_color_known=False,
    )
    assert found.places.axis.any() == true.places.axis.any()
    torch.testing.assert_close(found.places.axis, true.places.axis, rtol=0, atol=0.1)


@pytest.mark.parametrize(("base_color_known", "within"), [(False, 0.07), (True, math.inf)])
def test_base_colours_learned_under_a_misplaced_lamp_do_not_keep_it_there(base_color_known, within):
    """The only evidence against the misplaced lamp is that the base colours then contain its light."""
    true = FoundLamps(TRUE.places[:1], TRUE.intensity[:1])
    astray = FoundLamps(
        LampPlaces(true.places.position + torch.tensor([[0.15, 0.1, -0.1]]), torch.zeros(1, 3)),
        true.intensity,
    )
    seen = points(600)
    seen = dataclasses.replace(seen, position=4 * seen.position)
    of = patches(seen.position)
    of = dataclasses.replace(of, base_color=0.6 * of.base_color)
    even = Transport(torch.zeros(1, 600, 0), torch.full((1, 600, 3), 0.2))
    under_true, under_astray = (
        Transport(from_lamps(lamps.places, RADIUS, seen, of.roughness, None, None).sources, even.scene)
        for lamps in (true, astray)
    )
    painted = under_true.outgoing(WHITE, true.intensity) / under_astray.outgoing(WHITE, astray.intensity)
    learned = dataclasses.replace(of, base_color=of.base_color * painted)
    assert learned.base_color.max() < 1
    pixel = under_true.outgoing(of, true.intensity)
    torch.testing.assert_close(under_astray.outgoing(learned, astray.intensity), pixel)

    objective = Objective("linear", pixel.median().item(), STEPS, base_color_known)
    seen = dataclasses.replace(seen, pixel=pixel)
    found = settle_lamps(astray, RADIUS, even, FitPoints(seen, learned, None, None), objective)
    off = (found.places.position - true.places.position).norm(dim=-1).min()
    assert off < within
    assert not base_color_known or off > 0.15


def test_a_lamp_that_no_point_sees_is_dropped():
    """Its intensity is not given to another lamp, which would become far too bright."""
    true = FoundLamps(TRUE.places[:1], TRUE.intensity[:1])
    hidden = torch.tensor([[0.3, 0.2, -2.8]])
    start = FoundLamps(
        LampPlaces(torch.cat((true.places.position, hidden)), torch.zeros(2, 3)),
        torch.cat((true.intensity, 20 * true.intensity)),
    )
    seen, of, beside = photographed(true, speckled=True)
    objective = Objective("linear", seen.pixel.median().item(), STEPS, base_color_known=True)
    found = settle_lamps(start, RADIUS, beside, FitPoints(seen, of, GGX, half_room), objective)
    assert len(found.intensity) == 1
    torch.testing.assert_close(found.places.position, true.places.position, rtol=0, atol=0.01)
    torch.testing.assert_close(found.intensity, true.intensity, rtol=0.05, atol=0)


@pytest.mark.parametrize("broken", ["no points", "no lamps", "a pixel that is no number"])
def test_without_information_lamps_are_unchanged(broken):
    seen, of, beside = photographed(TRUE, speckled=True)
    start = TRUE
    if broken == "no points":
        seen, of, beside = seen[:0], of[:0], beside[torch.arange(0)]
    elif broken == "no lamps":
        start = FoundLamps(TRUE.places[:0], TRUE.intensity[:0])
    else:
        seen.pixel[0] = torch.nan
    objective = Objective("linear", 0.3, STEPS)
    found = settle_lamps(start, RADIUS, beside, FitPoints(seen, of, GGX, None), objective)
    torch.testing.assert_close(found.places.position, start.places.position)
    torch.testing.assert_close(found.intensity, start.intensity)
