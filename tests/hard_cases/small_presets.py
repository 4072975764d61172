"""Presets with small fields, for trainings of less than a minute on one core."""

from __future__ import annotations

from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import fixed_geometry, preset
from neilfpp_method.settings.types import NeilfConfig

SMALLER = {
    "host.sdf.width": 32,
    "host.sdf.feature_width": 16,
    "encoding.levels": 6,
    "encoding.log2_entries": 13,
    "encoding.sdf_log2_entries": 13,
    "encoding.max_resolution": 128,
    "radiance.layers": 2,
    "radiance.width": 32,
    "brdf.width": 16,
    "light.layers": 4,
    "light.width": 16,
    "host.volume.samples": 36,
}
"""Smaller fields, and fewer samples per ray."""


def small_paper_ngp() -> NeilfConfig:
    """The preset `paper-ngp` with small fields; light, lobe, directions, losses and rates are those of the
    preset.
    """
    return changed(preset("paper-ngp"), SMALLER)


def small_mesh(config: NeilfConfig) -> NeilfConfig:
    """These settings for geometry that is given as a mesh, with a small R."""
    return changed(fixed_geometry(config), {"radiance.layers": 2, "radiance.width": 32})
