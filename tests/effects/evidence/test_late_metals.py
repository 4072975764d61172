"""The second decision about metals, under the light of a half-trained model."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from neilfpp_method.effects.evidence.metals import find_metal, metals_evidence_in
from neilfpp_method.effects.places.gathering import Places
from neilfpp_method.effects.places.grid import neighbors
from neilfpp_method.effects.places.lit import light_up
from neilfpp_method.effects.plan import Decision, Plan
from neilfpp_method.effects.request import parse_effects
from neilfpp_method.effects.review import review_metals
from neilfpp_method.model import NeilfModel
from neilfpp_method.settings.presets import preset
from neilfpp_method.shading import LOBES
from tests.effects.balls import ball, sky
from tests.scenes import sphere_model

COUNT, VIEWS = 120, 8
LOBE = LOBES["spherical_gaussian"]


def two_halves(metallic: float) -> Places:
    """A ball of dull grey paint, and of another material with this metallic at a quarter of the places."""
    other = (torch.arange(COUNT) < COUNT // 4).float()[:, None]
    base_color = (0.3 + 0.4 * other).expand(-1, 3)
    return ball(base_color, 0.7 - 0.4 * other, metallic * other, LOBE, VIEWS, sky())


def painted_model(places: Places, effects: str = "auto") -> tuple[Plan, NeilfModel]:
    """A model under the true sky whose metals have been switched off, and its plan."""
    plan = Plan.begin(parse_effects(effects), preset("fast"))
    if plan.is_open("metals"):
        plan.decisions.append(Decision(0, "metals", False, "evidence", "as if measured"))
    model = sphere_model(plan.config)
    model.use(plan.config)
    model.light.resample(sky().log_radiance)
    model.facts = dataclasses.replace(model.facts, median_radiance=places.observed.pixel.median().item())
    return plan, model


def test_metal_that_the_trained_light_shows_is_switched_on_and_learned():
    places = two_halves(1.0)
    plan, model = painted_model(places)
    (decision,) = review_metals(plan, model, light_up(model, places), 1000)
    assert decision.on
    assert decision.step == 1000
    assert decision.reason.startswith("revised: reduction of the error in held-back views by metals")
    assert plan.config.brdf.metals
    with torch.no_grad():
        learned = model.brdf(places.observed.position).metallic[:, 0]
    is_metal = places.place < COUNT // 4
    assert learned[is_metal].median() > 0.7
    assert learned[~is_metal].median() < 0.2


def test_paint_does_not_earn_metals():
    places = two_halves(0.0)
    plan, model = painted_model(places)
    before = [parameter.clone() for parameter in model.brdf.parameters()]
    (decision,) = review_metals(plan, model, light_up(model, places), 1000)
    assert not decision.on
    assert not model.brdf.metals
    assert all(torch.equal(a, b) for a, b in zip(before, model.brdf.parameters(), strict=True))


def test_the_evidence_is_the_gain_of_the_metal_places():
    places = two_halves(1.0)
    _, model = painted_model(places)
    measured = metals_evidence_in(light_up(model, places), "linear")
    assert measured.samples == COUNT
    assert measured.value > 4 * measured.deviation


def test_in_display_values_the_evidence_is_the_share_of_clear_metal():
    places = two_halves(1.0)
    _, model = painted_model(places)
    measured = metals_evidence_in(light_up(model, places), "srgb")
    assert measured.value == pytest.approx(0.25, abs=0.1)
    assert measured.favours(chosen=False)


def test_deviations_of_photographs_are_no_clear_metal():
    """Errors of a fifth: metal has a lower error at many places of paint, but at few a much lower one.

    As in a full capture, 150 pixels decide on each place.
    """
    places = two_halves(0.0)
    noise = torch.randn(COUNT, VIEWS, generator=torch.Generator().manual_seed(0))[places.place, places.view]
    pixel = places.observed.pixel * (0.2 * noise)[:, None].exp()
    places = dataclasses.replace(places, observed=dataclasses.replace(places.observed, pixel=pixel))
    lit = light_up(painted_model(places)[1], places)
    lit = dataclasses.replace(lit, near=neighbors(places.shared_points().position, 150 // VIEWS))
    assert metals_evidence_in(lit, "srgb").value < 0.02


def test_black_paint_is_no_clear_metal():
    """All paint has highlights. Darker pixels look like a metal that reflects next to nothing."""
    places = two_halves(0.0)
    observed = dataclasses.replace(places.observed, pixel=0.02 * places.observed.pixel)
    places = dataclasses.replace(places, observed=observed)
    _, model = painted_model(places)
    assert metals_evidence_in(light_up(model, places), "srgb").value < 0.02


@pytest.mark.parametrize("response", ["linear", "srgb"])
def test_clear_metal_is_found_with_every_response(response: str):
    places = two_halves(1.0)
    _, model = painted_model(places)
    lit = light_up(model, places)
    with torch.no_grad():
        metallic = find_metal(lit, model.brdf, response).material.metallic[:, 0]
    is_metal = places.place < COUNT // 4
    assert metallic[is_metal].mean() > 0.8
    assert metallic[~is_metal].mean() < 0.1


@pytest.mark.parametrize("effects", ["auto,-metals", "none", "as-set"])
def test_what_the_user_has_decided_stays(effects):
    places = two_halves(1.0)
    lit = light_up(painted_model(places)[1], places)
    plan, model = painted_model(places, effects)
    assert review_metals(plan, model, lit, 1000) == []


def test_metals_that_are_on_are_not_reviewed():
    places = two_halves(1.0)
    plan, model = painted_model(places)
    plan.decisions.append(Decision(5, "metals", True, "evidence", "as if measured"))
    model.use(plan.config)
    assert review_metals(plan, model, light_up(model, places), 1000) == []
