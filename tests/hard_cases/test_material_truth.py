"""Materials that are hard to tell, on a given mesh under a known light: each comes out within a bound of
the truth.

The images are integrals of the rendering equation by quadrature in NumPy (`tests.oracles.brdf`), apart
from the package: a ball of one material under a sky with two coloured lamps. Nothing but B is unknown.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.data.images import write_exr
from neilfpp_method.fields.direction_map import map_directions
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import fixed_geometry, preset
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.train.build import show_known_light
from neilfpp_method.train.loop import train
from tests.data.make_capture import RADIUS, SCALE, make_capture
from tests.hard_cases.test_training import repaint
from tests.oracles import brdf
from tests.train.small_runs import small_training

pytestmark = [pytest.mark.hard, pytest.mark.usefixtures("without_shape_checks")]

ROWS, COLUMNS = 96, 192
LAMPS = (([0.48, 0.6, 0.64], [9.0, 7.0, 5.0]), ([-0.8, 0.0, 0.6], [1.0, 2.0, 4.0]))
SHARPNESS = 25.0
"""Of a lamp, exp(25 (cos − 1)): half of it lies within 13°, three texels of the map."""


@dataclass(frozen=True)
class Truth:
    """A material, and the largest mean errors of what is recovered."""

    base_color: tuple[float, float, float]
    roughness: float
    metallic: float
    base_color_bound: float
    roughness_bound: float
    metallic_bound: float


CASES = {
    "polished metal": Truth((0.9, 0.6, 0.3), 0.35, 1.0, 0.1, 0.1, 0.2),
    "rough metal": Truth((0.9, 0.6, 0.3), 0.7, 1.0, 0.1, 0.15, 0.2),
    "coloured plastic": Truth((0.7, 0.2, 0.1), 0.4, 0.0, 0.1, 0.15, 0.2),
    "chalk": Truth((0.95, 0.95, 0.95), 0.95, 0.0, 0.1, 0.2, 0.2),
    "soot": Truth((0.02, 0.02, 0.02), 0.9, 0.0, 0.05, 0.2, 0.2),
}


def sky(direction: np.ndarray) -> np.ndarray:
    """Linear radiance (K, 3) from unit directions (K, 3)."""
    total = 0.3 + 0.2 * direction[:, 2:] * np.array([0.2, 0.5, 1.0])
    for towards, color in LAMPS:
        total = total + np.exp(SHARPNESS * (direction @ np.array(towards) - 1))[:, None] * np.array(color)
    return total


def even_directions() -> tuple[np.ndarray, float]:
    """Directions at the middles of cells of equal solid angle, and that angle."""
    cosine = 1 - 2 * (np.arange(ROWS) + 0.5) / ROWS
    azimuth = 2 * np.pi * (np.arange(COLUMNS) + 0.5) / COLUMNS
    sine = np.sqrt(1 - cosine**2)[:, None]
    shape = (ROWS, COLUMNS)
    parts = (sine * np.cos(azimuth), sine * np.sin(azimuth), np.broadcast_to(cosine[:, None], shape))
    return np.stack(parts, -1).reshape(-1, 3), 4 * np.pi / (ROWS * COLUMNS)


def rendered(truth: Truth):
    """What the ball sends, for `repaint`."""
    wi, solid_angle = even_directions()
    radiance = sky(wi) * solid_angle
    b, r, m = (
        np.array([v], float) if np.isscalar(v) else np.array(v)
        for v in (truth.base_color, truth.roughness, truth.metallic)
    )

    def look(normal: np.ndarray, seen_along: np.ndarray) -> np.ndarray:
        colors = np.zeros_like(normal)
        for k, (n, d) in enumerate(zip(normal, seen_along, strict=True)):
            if not np.isfinite(n).all() or n @ d >= 0:
                continue
            above = wi @ n > 0
            diffuse, specular = brdf("ggx", b, r, m, n, -d, wi[above])
            cosine = (wi[above] @ n)[:, None]
            colors[k] = ((diffuse + specular) * radiance[above] * cosine).sum(0)
        return colors

    return look


def config_under(map_file: Path) -> NeilfConfig:
    """`fast` on a mesh, small, whose light is known: B alone is learned."""
    return changed(
        fixed_geometry(preset("fast")),
        {
            "light": {"kind": "distant", "map": str(map_file)},
            "shading.lobe": "ggx",
            "shading.train_samples": 48,
            "inter_reflection.mode": "off",
            "brdf": {"layers": 2, "width": 32},
            "radiance": {"layers": 1, "width": 16},
            "encoding": {"levels": 3, "log2_entries": 10, "max_resolution": 32},
            "background": {"layers": 2, "width": 16},
            "train": {"sdf_steps": 1, "material_steps": 300, "joint_steps": 0, "rays": 96, "fresh": 1.0},
        },
    )


@pytest.mark.parametrize("case", CASES)
def test_a_material_comes_out_as_it_is(tmp_path: Path, case: str) -> None:
    truth, directions = CASES[case], map_directions(32, 64)
    radiance = sky(directions.reshape(-1, 3).double().numpy()).reshape(32, 64, 3)
    write_exr(tmp_path / "sky.exr", {"RGB": radiance.astype(np.float32)})
    root = repaint(make_capture(tmp_path / "ball", masks=True), rendered(truth))
    config = config_under(tmp_path / "sky.exr")
    config = dataclasses.replace(config, train=dataclasses.replace(config.train, checkpoint_every=1000))
    training = small_training(root, tmp_path / "run", config)
    show_known_light(training.model)
    train(training)
    normal = torch.nn.functional.normalize(
        torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=-1
    )
    found = training.model.materials(normal * RADIUS / SCALE)
    errors = {
        "base_color": (found.base_color - torch.tensor(truth.base_color)).abs().mean().item(),
        "roughness": (found.roughness - truth.roughness).abs().mean().item(),
        "metallic": (found.metallic - truth.metallic).abs().mean().item(),
    }
    assert training.skipped == 0
    for name, error in errors.items():
        assert error < getattr(truth, f"{name}_bound"), errors
