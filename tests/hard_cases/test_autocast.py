"""Joint steps within autocast to bfloat16 agree with float32, for each kind of host and light."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from typing import Any

import pytest
import torch

from neilfpp_method.attach import attach_neilf
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.types import NeilfConfig
from tests.hard_cases.small_presets import small_mesh
from tests.hard_cases.test_known_materials import ball_mesh, closed_form_host
from tests.scenes import sphere_batch, tiny_config
from tests.train.small_runs import solved_light

pytestmark = pytest.mark.usefixtures("without_shape_checks")

STEPS = 8
"""Steps whose mean loss is compared: the directions of a step are random."""
LARGEST = 0.05
"""Largest relative difference of the mean losses."""


def volsdf(config: NeilfConfig) -> VolSdfHost:
    torch.manual_seed(0)
    return VolSdfHost(config, SceneFacts("linear", 0.2, 3.0, "constant"))


HOSTS: Mapping[str, Callable[[NeilfConfig], Any]] = {
    "volsdf": volsdf,
    "mesh": lambda config: ball_mesh(0.2, config),
    "function": lambda config: closed_form_host,
}
LIGHTS: Mapping[str, NeilfConfig] = {
    "field, L_ref": tiny_config(),
    "field, traced": changed(tiny_config(), {"light.inter_reflection": "hard"}),
    "map, traced": solved_light(tiny_config()),
}


def mean_loss(host: str, light: str, autocast: bool) -> float:
    """The mean loss of joint steps without an optimizer; all gradients are finite."""
    config = LIGHTS[light]
    neilf = attach_neilf(HOSTS[host](config), small_mesh(config) if host == "mesh" else config)
    torch.manual_seed(1)
    total = 0.0
    for _ in range(STEPS):
        with torch.autocast("cpu", dtype=torch.bfloat16) if autocast else nullcontext():
            loss = neilf.losses(sphere_batch(), "joint").loss
        loss.backward()
        total += loss.item() / STEPS
    gradients = [p.grad for p in neilf.parameters() if p.grad is not None]
    assert gradients
    assert all(gradient.isfinite().all() for gradient in gradients)
    return total


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("host", HOSTS)
def test_a_step_has_the_loss_of_float32(host, light):
    half, exact = (mean_loss(host, light, autocast) for autocast in (True, False))
    assert half == pytest.approx(exact, rel=LARGEST)
