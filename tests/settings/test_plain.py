"""Conversion of settings to and from plain values, and changes of settings: errors name the setting in one
line.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from typing import get_args, get_type_hints

import pytest

from neilfpp_method.errors import UserError
from neilfpp_method.settings.plain import changed, from_dict, to_dict
from neilfpp_method.settings.presets import PRESETS, fixed_geometry, free_light, preset
from neilfpp_method.settings.types import (
    FreeLightConfig,
    HashGridConfig,
    MapLightConfig,
    MeshConfig,
    NeilfConfig,
)

EVERY = (
    [preset(name) for name in PRESETS]
    + [fixed_geometry(preset(name)) for name in PRESETS]
    + [free_light(preset("fast"))]
)


def leaves(kind: type, where: str = "") -> Iterator[str]:
    """The dotted names of all settings. A part with several kinds has those of each kind, so a setting that
    two kinds of light have occurs twice.
    """
    for name, hint in get_type_hints(kind).items():
        parts = [part for part in (hint, *get_args(hint)) if dataclasses.is_dataclass(part)]
        if parts:
            for part in parts:
                yield from leaves(part, f"{where}{name}.")
        else:
            yield f"{where}{name}"


def test_there_are_not_too_many_settings():
    """Strictly counted: every field of every kind of light, host and encoding."""
    assert len(list(leaves(NeilfConfig))) <= 85


def test_settings_of_every_kind_are_counted():
    names = list(leaves(NeilfConfig))
    assert {"light.map", "light.width", "host.sdf.layers", "host.path", "encoding.levels"} <= set(names)
    assert names.count("light.kind") == names.count("light.monochrome") == 2


@pytest.mark.parametrize("config", EVERY, ids=lambda config: f"{config.preset}-{config.light.kind}")
def test_settings_survive_json(config):
    assert from_dict(NeilfConfig, json.loads(json.dumps(to_dict(config)))) == config
    assert changed(NeilfConfig(), json.loads(json.dumps(to_dict(config)))) == config


def test_a_change_keeps_all_other_settings():
    config = changed(
        preset("fast"), {"train.rays": 7, "light": {"fit": {"points": 3}}, "host": {"sdf.width": 9}}
    )
    assert (config.train.rays, config.light.fit.points, config.host.sdf.width) == (7, 3, 9)
    back = {"train.rays": 512, "light.fit.points": 1024, "host.sdf.width": 64}
    assert changed(config, back) == preset("fast")


def test_a_new_kind_has_its_own_settings():
    fast = preset("fast")
    assert changed(fast, {"light.kind": "distant"}).light == MapLightConfig("distant", 48, fit=fast.light.fit)
    assert changed(fast, {"light": {"kind": "free", "width": 8}}).light == FreeLightConfig(width=8)
    assert changed(fast, {"host.kind": "mesh", "host.path": "a.ply"}).host == MeshConfig(path="a.ply")
    assert changed(NeilfConfig(), {"encoding.kind": "hash", "encoding.levels": 4}).encoding == HashGridConfig(
        levels=4
    )


@pytest.mark.parametrize("name", PRESETS)
def test_a_given_mesh_has_no_settings_of_recovered_geometry(name):
    values = to_dict(fixed_geometry(preset(name)))
    assert values["host"] == {"kind": "mesh", "path": None}
    assert "volume" not in values
    assert not {"eikonal", "points", "mask"} & values["loss"].keys()


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        ({"trian": {"rays": 3}}, "config: unknown setting 'trian'; did you mean 'train'?"),
        ({"train.ray": 3}, "config.train: unknown setting 'ray'; did you mean 'rays'?"),
        ({"light.width": 3}, "config.light: unknown setting 'width'"),
        ({"light.kind": "sun"}, "config.light.kind: 'sun' is not a choice"),
        ({"light.kind": ["free"]}, "config.light.kind"),
        ({"train.rays": "many"}, "config.train.rays: 'many' where int belongs"),
        ({"train.rays": True}, "config.train.rays: True where int belongs"),
        ({"train.rays": [1, 2]}, "config.train.rays: a list where one value belongs"),
        ({"train": 3}, "config.train: 3 where settings belong"),
        ({"train.rays": 3, "train": 4}, "config.train is set twice"),
        ({"background.color": [1.0, 2.0]}, "config.background.color: 2 numbers where 3 belong"),
        ({"background.color": [1.0, 2.0, "red"]}, "config.background.color: 'red' where float belongs"),
        ({"light.inter_reflection": "soft"}, "config.light.inter_reflection: 'soft' is not a choice"),
        ({"light.inter_reflection": False}, "config.light.inter_reflection: 'False' is not a choice"),
        ({"host.kind": "mesh", "host.volume.samples": 3}, "config.host: unknown setting 'volume'"),
        ({"host.kind": "mesh", "host.loss.eikonal": 1.0}, "config.host: unknown setting 'loss'"),
        # Names of earlier versions.
        ({"volume.samples": 3}, "config: unknown setting 'volume'"),
        ({"loss.eikonal": 1.0}, "config.loss: unknown setting 'eikonal'"),
    ],
)
def test_the_wrong_setting_is_named(values, complaint):
    with pytest.raises(UserError) as error:
        changed(preset("fast"), values)
    assert complaint in str(error.value)
    assert "\n" not in str(error.value)
