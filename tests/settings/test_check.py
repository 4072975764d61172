"""Impossible settings are refused in the same way by the command, the plugin and `attach_neilf`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from neilfpp_method.attach import attach_neilf
from neilfpp_method.errors import UserError
from neilfpp_method.settings.check import check_config
from neilfpp_method.settings.presets import PRESETS, fixed_geometry, free_light, preset
from tests.scenes import tiny_config


def with_setting(config: Any, room: str, **settings: object) -> Any:
    """The same settings with others in a group with a dotted name, without the checks of `changed`."""
    part, _, rest = room.partition(".")
    group = getattr(config, part)
    return replace(
        config, **{part: with_setting(group, rest, **settings) if rest else replace(group, **settings)}
    )


WRONG = {
    "a surface of negative width": (
        preset("fast"),
        "host.volume",
        {"beta_final": -0.1},
        r"--config\.host\.volume\.beta-final is -0\.1; set it to 0 \(no bound\) or more",
    ),
    "a density without width": (
        preset("fast"),
        "host.volume",
        {"beta_init": 0.0},
        "host.volume.beta-init is 0.0; set it to a number above 0",
    ),
    "too few samples": (
        preset("fast"),
        "host.volume",
        {"samples": 3},
        "host.volume.samples is 3; set it to 4 or more",
    ),
    "a negative weight of a loss of G": (
        preset("fast"),
        "host.loss",
        {"eikonal": -1.0},
        "--config.host.loss.eikonal is -1.0; set it to 0 or more",
    ),
    "a negative weight of one stage": (
        preset("fast"),
        "host.loss",
        {"hessian": (1e-3, 1e-3, -1.0)},
        r"--config.host.loss.hessian is \(0.001, 0.001, -1.0\); set it to numbers of 0 or more",
    ),
    "a learning rate that falls to 0": (
        preset("fast"),
        "optimizer",
        {"final": (0.1, 0.0, 0.1)},
        r"optimizer.final is \(0.1, 0.0, 0.1\); set it to numbers above 0",
    ),
    "a negative number of drops": (
        preset("fast"),
        "optimizer",
        {"drops": (0, -1, 0)},
        r"optimizer.drops is \(0, -1, 0\); set it to numbers of 0 or more",
    ),
    "no incident directions": (
        preset("fast"),
        "shading",
        {"train_samples": 0},
        "train-samples is 0; set it to 1",
    ),
    "no rays": (preset("fast"), "train", {"rays": 0}, "--config.train.rays is 0; set it to 1 or more"),
    "a negative seed": (preset("fast"), "train", {"seed": -1}, "train.seed is -1; set it to 0 to 4294967295"),
    "a seed beyond 32 bits": (preset("fast"), "train", {"seed": 2**32}, "train.seed is 4294967296"),
    "more than the whole weight": (preset("fast"), "shading", {"hit_share": 1.5}, "hit-share is 1.5"),
    "a base colour that no weights have": (
        preset("fast"),
        "brdf",
        {"initial_base_color": 1.0},
        "initial-base-color is 1.0; set it to a number above 0 and below 1",
    ),
    "a metallic that no weights have": (
        preset("fast"),
        "brdf",
        {"initial_metallic": 0.0},
        "initial-metallic is 0.0",
    ),
    "a rate that climbs": (
        preset("fast"),
        "optimizer",
        {"brdf": -0.1},
        "optimizer.brdf is -0.1; set it to 0",
    ),
    "a rate that is no number": (preset("fast"), "optimizer", {"light": float("nan")}, "light is nan"),
    "a negative weight": (preset("fast"), "loss", {"volume": -1.0}, "loss.volume is -1.0"),
    "a scene without extent": (preset("fast"), "background", {"radius": 0.0}, "background.radius is 0.0"),
}


@pytest.mark.parametrize("case", WRONG)
def test_impossible_values_are_refused(case):
    config, room, settings, message = WRONG[case]
    with pytest.raises(UserError, match=message):
        check_config(with_setting(config, room, **settings))


def test_a_map_that_l_ref_cannot_train_is_refused():
    config = preset("fast")
    object.__setattr__(config.light, "inter_reflection", "soft")  # the tests check types, Python does not
    with pytest.raises(UserError, match="'soft' is not a choice"):
        check_config(config)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_and_their_variants_are_accepted(name):
    for config in (preset(name), fixed_geometry(preset(name))):
        check_config(config)
    check_config(free_light(preset("fast")))


def test_attaching_checks_the_settings():
    config = with_setting(tiny_config(), "train", rays=0)
    with pytest.raises(UserError, match="rays is 0"):
        attach_neilf(lambda origins, directions: (origins, origins, origins), config=config)
