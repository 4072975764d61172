"""The networks of the presets have the paper's sizes (METHOD §5): weights and biases, counted by hand."""

from __future__ import annotations

import pytest
from torch import nn

from neilfpp_method.fields.brdf import BrdfField
from neilfpp_method.fields.incident_light import IncidentLightField
from neilfpp_method.fields.outgoing_radiance import OutgoingRadianceField
from neilfpp_method.fields.sdf import SdfField
from neilfpp_method.settings.presets import preset


def linear(inputs: int, outputs: int) -> int:
    return (inputs + 1) * outputs


def count(module: nn.Module) -> int:
    return sum(p.numel() for p in module.parameters())


MLP = preset("paper-mlp")
WAVES_6 = 3 + 2 * 3 * 6
WAVES_4 = 3 + 2 * 3 * 4
GRID = 3 + 16 * 2
# 16 → 4096 in 16 levels, each 256^(1/15) = 1.4473 finer; those of 16, 23, 34, 49, 70 cells fit into 2¹⁹
# entries
TABLE = 2 * (17**3 + 24**3 + 35**3 + 50**3 + 71**3 + 11 * 2**19)


def test_sdf_of_the_mlp_setting():
    plain = linear(WAVES_6, 256) + 6 * linear(256, 256) + linear(256 + WAVES_6, 256) + linear(256, 1 + 256)
    row_lengths = 8 * 256 + 1 + 256  # lengths of the weight normalisation
    assert count(SdfField(MLP.host.sdf, MLP.encoding, 3.0)) == plain + row_lengths


def test_outgoing_radiance_of_the_mlp_setting():
    field = OutgoingRadianceField(MLP.radiance, MLP.encoding, 256, 3.0, 1.0)
    assert count(field) == linear(3 + WAVES_4 + 3 + 256, 256) + 3 * linear(256, 256) + linear(256, 3)


def test_brdf_of_the_mlp_setting():
    expected = (
        linear(WAVES_6, 512) + 6 * linear(512, 512) + linear(512 + WAVES_6, 512) + linear(512, 3 + 1 + 1)
    )
    assert count(BrdfField(MLP.brdf, MLP.encoding, 3.0)) == expected


@pytest.mark.parametrize(("name", "direction"), [("paper-mlp", WAVES_6), ("paper-ngp", 25)])
def test_incident_light_of_both_settings(name, direction):
    middle = linear(128 + direction + 3, 128)
    expected = (
        linear(direction, 128) + 3 * linear(128, 128) + middle + 3 * linear(128, 128) + linear(128, 1)
    )  # one channel
    assert count(IncidentLightField(preset(name).light, preset(name).encoding, 10.0, 1.0)) == expected


def test_grids_of_the_ngp_setting():
    config = preset("paper-ngp")
    sdf = linear(GRID, 64) + linear(64, 64) + linear(64, 1 + 64)
    radiance = linear(3 + 16 + 3 + 64, 64) + 3 * linear(64, 64) + linear(64, 3)  # without its own grid
    brdf = linear(GRID, 120) + linear(120, 120) + linear(120, 5)
    three_heads = 3 * (linear(GRID, 64) + linear(64, 64)) + linear(64, 5)
    assert abs(brdf / three_heads - 1) < 0.02  # as many weights as in the published code
    assert count(SdfField(config.host.sdf, config.encoding, 3.0)) == TABLE + sdf
    assert count(OutgoingRadianceField(config.radiance, config.encoding, 64, 3.0, 1.0)) == radiance
    assert count(BrdfField(config.brdf, config.encoding, 3.0)) == TABLE + brdf
