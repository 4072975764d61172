"""On the rendered ground truth, the true material and the true incident light give the true outgoing
radiance.

The light field was rendered by a path tracer: 64 surface points, 4096 directions of equal weight 2π/4096, 16
views each.
"""

from __future__ import annotations

import math
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.shading import SPHERICAL_GAUSSIAN, shade
from neilfpp_method.structures import Incident, IncidentSamples, Material

DATA = Path(os.environ.get("NEILFPP_DATA", Path(__file__).parents[2].parent / "shared" / "data"))


@pytest.fixture(params=["tabletop_env", "tabletop_mix"])
def light_field(request):
    path = DATA / request.param / "light" / "light_field_gt.npz"
    if not path.is_file():
        pytest.skip(
            f"the rendered light field {path} is not at hand; NEILFPP_DATA names the folder of the captures"
        )
    return {name: torch.from_numpy(values.astype(np.float32)) for name, values in np.load(path).items()}


def test_the_estimator_closes_the_rendering_equation(light_field):
    truth = light_field["outgoing"]
    wi, n = light_field["wi"], light_field["normals"]
    samples = IncidentSamples(wi, torch.full(wi.shape[:2], 1 / (2 * math.pi)))
    material = Material(
        light_field["base_color"], light_field["roughness"][:, None], light_field["metallic"][:, None]
    )
    views = light_field["wo"].unbind(1)
    shaded = [
        shade(material, n, wo, Incident.of(samples, light_field["incident"]), SPHERICAL_GAUSSIAN).color
        for wo in views
    ]
    outgoing = torch.stack(shaded, 1)

    assert outgoing.sum((0, 1)).allclose(truth.sum((0, 1)), rtol=0.02)
    # The remaining difference per point is noise of the path tracer and of 4096 directions under small lamps.
    assert ((outgoing - truth).abs().sum() / truth.sum()).item() < 0.05
