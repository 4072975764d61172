"""A convex ball under a synthetic sky, photographed from all around: places, material and light are known."""

from __future__ import annotations

import pytest
import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.effects.evidence.lamps import LampTrial
from neilfpp_method.effects.first_light import FirstLight
from neilfpp_method.effects.places.data import ROWS, PlaceData, place_transport
from neilfpp_method.effects.places.fit import PlaceFit
from neilfpp_method.effects.places.gathering import Places
from neilfpp_method.effects.places.grid import ROUGHNESSES
from neilfpp_method.fields.environment import EnvironmentLight
from neilfpp_method.lighting.map_transport import from_texels
from neilfpp_method.shading import LOBES
from neilfpp_method.shading.brdf import Lobe
from neilfpp_method.structures import Material, Observed

DIRECTIONS = 16
"""Number of directions per texel from which a pixel of the ball is computed."""


def sky() -> EnvironmentLight:
    """A bright window above a dark ground."""
    environment = EnvironmentLight(ROWS, 1.0)
    radiance = torch.full((3, ROWS, 2 * ROWS), 0.3)
    radiance[:, : ROWS // 2] = 1.0
    radiance[:, ROWS // 4 : 3 * ROWS // 8, 10:14] = 20.0
    environment.show(radiance)
    return environment


def ball(
    base_color: Tensor,
    roughness: Tensor,
    metallic: Tensor,
    lobe: Lobe | None,
    views: int = 9,
    environment: EnvironmentLight | None = None,
) -> Places:
    """P places of the given materials, each in so many views, under `sky` or another map."""
    torch.manual_seed(0)
    count = len(base_color)
    normal = torch.nn.functional.normalize(torch.randn(count, 3), dim=-1).repeat_interleave(views, 0)
    aside = torch.nn.functional.normalize(torch.randn(len(normal), 3), dim=-1)
    wo = torch.nn.functional.normalize(normal + 0.9 * aside, dim=-1)
    material = Material(*(v.repeat_interleave(views, 0) for v in (base_color, roughness, metallic)))
    pixel = _rendered(
        Observed(normal, normal, wo, torch.zeros_like(normal)), material, lobe, environment or sky()
    )
    place = torch.arange(count).repeat_interleave(views)
    return Places(count, place, torch.arange(views).repeat(count), Observed(normal, normal, wo, pixel))


def data_of(places: Places, lobe: Lobe, response: str = "linear") -> PlaceData:
    """The data of a fit to places that have no neighbours in the way of their light."""
    typical = places.observed.pixel.median().item()
    return PlaceData(places, place_transport(places, lobe, None), typical, response)


def first_light_of_sky(response: str = "linear") -> FirstLight:
    """An initial light that is `sky`, with one grey place."""
    one = torch.ones(1, 1)
    data = data_of(ball(one.expand(1, 3), one, 0 * one, LOBES["ggx"]), LOBES["ggx"], response)
    index = torch.tensor([ROUGHNESSES.index(0.45)])
    fit = PlaceFit(sky().log_radiance, 0.5 * one.expand(1, 3), index, 0 * index)
    trial = LampTrial(data.hold_back(0, 2), pytest.fail)
    return FirstLight(fit, 0.33, {0.33: 0.1}, data, metals=True, lamp_trial=trial)


def _rendered(
    dark: Observed, material: Material, lobe: Lobe | None, environment: EnvironmentLight
) -> Float[Tensor, "N 3"]:
    radiance = environment.log_radiance.exp().flatten(1).t()
    drawn = [from_texels(environment, dark, material.roughness, lobe, None) for _ in range(DIRECTIONS)]
    return torch.stack([carried.outgoing(material, radiance) for carried in drawn]).mean(0)
