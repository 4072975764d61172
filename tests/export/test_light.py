"""Exported light: its frame, its units and its pixels, and the points of the probes."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.images import read_image
from neilfpp_method.errors import UserError
from neilfpp_method.export import light as light_module
from neilfpp_method.export.light import export_light
from neilfpp_method.export.probes import spread, spread_over_surface
from neilfpp_method.model import NeilfModel
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.types import MapLightConfig
from neilfpp_method.structures import OrientedPoints, RayBatch, SurfaceHits
from neilfpp_method.train.run import Run
from tests.data.make_capture import CENTER, SCALE, make_capture
from tests.scenes import meet_ball, tiny_config

RADIUS = 0.6
POSITION = torch.tensor([[0.9, 0.0, 0.3], [-0.2, 0.8, 0.4]])
INTENSITY = torch.tensor([[0.5, 0.25, 0.125], [0.1, 0.2, 0.4]])
AXIS = torch.tensor([[0.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


class Ball(torch.nn.Module):
    """A host that is a black sphere around the origin, which can be hidden."""

    def __init__(self, radius: float = RADIUS) -> None:
        super().__init__()
        self.radius = radius

    def render(self, rays: RayBatch) -> SurfaceHits:
        position, hit = meet_ball(rays, self.radius)
        position = torch.where(hit[:, None] > 0, position, rays.origins)
        return SurfaceHits(torch.zeros_like(position), position, position / RADIUS * hit[:, None], hit, hit)


def make_run(folder: Path, kind: str, step: int = 12, radius: float = RADIUS) -> Run:
    config = tiny_config()
    light = config.light if kind == "free" else MapLightConfig(kind=kind, environment_height=9)
    config = dataclasses.replace(
        config,
        light=dataclasses.replace(light, inter_reflection="off"),
    )
    torch.manual_seed(0)
    model = NeilfModel(Ball(radius), config, SceneFacts("linear", 0.2, 3.0, "constant")).eval()
    if kind != "free":
        model.light.show(torch.rand(3, 9, 18) + 0.1)
    if kind == "distant_near":
        model.lamps.place(POSITION, INTENSITY, AXIS)
    return Run(folder, config, load_capture(make_capture(folder / "capture")), model.facts, model, step)


def pixels(path: Path) -> np.ndarray:
    return read_image(path).pixels


def test_the_map_is_written_unchanged(tmp_path):
    run = make_run(tmp_path, "distant")
    written = export_light(run, tmp_path / "light")
    assert written == light_module.ExportedLight(tmp_path / "light" / "environment.exr", 0, 0)
    expected = run.model.light.log_radiance.exp().permute(1, 2, 0).numpy()
    np.testing.assert_array_equal(pixels(tmp_path / "light" / "environment.exr"), expected)
    assert json.loads((tmp_path / "light" / "lamps.json").read_text()) == {
        "format": 1,
        "frame": "world",
        "lamps": [],
    }
    assert not (tmp_path / "light" / "probes.json").exists()


def test_lamps_give_the_same_irradiance_in_world_and_scene(tmp_path):
    run = make_run(tmp_path, "distant_near")
    assert export_light(run, tmp_path / "light").lamps == 2
    described = json.loads((tmp_path / "light" / "lamps.json").read_text())
    assert described["format"] == 1
    assert [lamp["axis"] for lamp in described["lamps"]] == [None, [0.0, -1.0, 0.0]]
    at = np.array([0.1, -0.2, 0.6])  # a point of the scene, which is CENTER + SCALE · at in the world
    for lamp, position, intensity in zip(
        described["lamps"], POSITION.numpy(), INTENSITY.numpy(), strict=True
    ):
        np.testing.assert_allclose(lamp["position"], CENTER + SCALE * position, atol=1e-6)
        assert lamp["radius"] == pytest.approx(0.06 * SCALE)
        # Irradiance, intensity over squared distance, is the same in both frames.
        distance = np.linalg.norm(np.array(lamp["position"]) - (CENTER + SCALE * at))
        expected = intensity / np.square(position - at).sum()
        np.testing.assert_allclose(np.array(lamp["intensity"]) / distance**2, expected, rtol=1e-5)
        np.testing.assert_allclose(
            np.array(lamp["radiance"]) * np.pi * lamp["radius"] ** 2, lamp["intensity"], rtol=1e-5
        )


def test_probes_have_the_incident_light_above_the_surface(tmp_path, monkeypatch):
    monkeypatch.setattr(light_module, "PROBE_HEIGHT", 9)
    run = make_run(tmp_path, "distant_near")
    run.model.lamps.place(POSITION[:0], INTENSITY[:0])
    assert export_light(run, tmp_path / "light", probes=5).probes == 5
    described = json.loads((tmp_path / "light" / "probes.json").read_text())
    assert described["frame"] == "world"
    sky = pixels(tmp_path / "light" / "environment.exr")
    j, i = np.indices((9, 18))
    theta, phi = np.pi * j / 8, 2 * np.pi * (i + 0.5) / 18
    directions = np.stack((np.sin(phi) * np.sin(theta), np.cos(phi) * np.sin(theta), np.cos(theta)), -1)
    for listed in described["probes"]:
        outwards = (np.array(listed["position"]) - CENTER) / (SCALE * RADIUS)
        np.testing.assert_allclose(outwards, listed["normal"], atol=1e-4)
        shown, cosine = pixels(tmp_path / "light" / listed["file"]), directions @ np.array(listed["normal"])
        above = (cosine > 1e-3) & (j % 8 > 0)  # the rows of the poles are one direction each
        np.testing.assert_allclose(shown[above], sky[above], rtol=1e-3)
        assert (shown[cosine < -1e-3] == 0).all()


def test_a_free_light_is_exported_as_probes_only(tmp_path, monkeypatch):
    monkeypatch.setattr(light_module, "PROBE_HEIGHT", 8)
    written = export_light(make_run(tmp_path, "free"), tmp_path / "light")
    assert written == light_module.ExportedLight(None, 0, 16)
    assert {path.name for path in (tmp_path / "light").iterdir()} == {"probes", "probes.json"}
    shown = [pixels(path) for path in sorted((tmp_path / "light" / "probes").iterdir())]
    assert len(shown) == 16
    assert all(picture.shape == (8, 16, 3) and picture.max() > 0 for picture in shown)


def test_chosen_points_differ_in_position_and_normal():
    corners = torch.tensor([[1.0, 1.0, 0.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0], [1.0, -1.0, 0.0]])
    floor = torch.cat((corners, 0.9 * corners, 0.5 * corners))
    up, aside = torch.tensor([[0.0, 0.0, 1.0]]), torch.tensor([[1.0, 0.0, 0.0]])
    points = OrientedPoints(torch.cat((floor, 0.1 * up)), torch.cat((up.expand(12, -1), aside)))
    chosen = spread(points, 4).tolist()
    assert 12 in chosen  # in the middle, but a wall
    assert len(set(chosen)) == 4
    assert len(spread(points, 99)) == 13
    assert sorted(spread(points, 13).tolist()) == list(range(13))


def test_surface_points_are_deterministic(tmp_path):
    run = make_run(tmp_path, "distant")
    one, other = spread_over_surface(run, 20), spread_over_surface(run, 20)
    assert torch.equal(one.position, other.position)
    torch.testing.assert_close(one.position.norm(dim=-1), torch.full((20,), RADIUS), atol=1e-4, rtol=0)
    nearest = torch.cdist(one.position, one.position).fill_diagonal_(9.0).amin()
    assert nearest > 0.5 * RADIUS * (4 * np.pi / 20) ** 0.5  # half of the width of a twentieth of the ball


def test_what_cannot_be_exported_is_refused(tmp_path):
    for run, probes, complaint in (
        (make_run(tmp_path / "early", "distant", step=4), None, "no light yet at step 4"),
        (make_run(tmp_path / "many", "distant"), 1025, "1025 probes"),
        (make_run(tmp_path / "fewer", "distant"), -1, "-1 probes"),
        (make_run(tmp_path / "empty", "free", radius=0.0), None, "no training view sees a surface"),
        (make_run(tmp_path / "also-empty", "distant", radius=0.0), 3, "no training view sees a surface"),
    ):
        with pytest.raises(UserError, match=complaint):
            export_light(run, tmp_path / "light", probes)
    assert not (tmp_path / "light").exists()
