"""The protocols on a capture whose truth is known: a sphere, with a stand-in model that evaluates it
analytically.
"""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import nn

from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.images import read_image, write_exr, write_png
from neilfpp_method.data.mesh import Mesh
from neilfpp_method.data.truth import LightField, Truth
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate import protocols, scene_metrics, views
from neilfpp_method.evaluate.protocols import evaluate, protocol, write_metrics
from neilfpp_method.evaluate.scene_metrics import light_metrics
from neilfpp_method.evaluate.views import (
    known_test_views,
    mean_observed_color,
    render_test_views,
    render_view,
    surface_points,
)
from neilfpp_method.model import NeilfModel
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.presets import preset
from neilfpp_method.structures import Maps, Material, RayBatch
from neilfpp_method.train.run import Run
from tests.data import make_capture as scene

SPHERE = scene.RADIUS / scene.SCALE  # radius in the scene frame


class KnownSphere(NeilfModel):
    """A model that returns the truth of `make_capture`, with given errors."""

    def __init__(self, base_color_factor: float = 1.0, light_factor: float = 1.0) -> None:
        nn.Module.__init__(self)
        self.gains = None
        self.somewhere = nn.Parameter(torch.zeros(1))
        self.base_color_factor = base_color_factor
        self.light_factor = light_factor
        self.host = SimpleNamespace(sdf=lambda x: x.norm(dim=-1) - SPHERE)
        self.sizes: list[int] = []

    def host_maps(self, rays: RayBatch) -> Maps:
        maps = self.maps(rays)
        names = ("base_color", "roughness", "metallic")
        return dataclasses.replace(maps, **{name: torch.zeros_like(getattr(maps, name)) for name in names})

    def maps(self, rays: RayBatch) -> Maps:
        self.sizes.append(len(rays))
        middle = -(rays.origins * rays.directions).sum(-1)
        inside = middle**2 - rays.origins.square().sum(-1) + SPHERE**2
        hit = (inside > 0)[:, None]
        depth = (middle - inside.clamp_min(0).sqrt())[:, None]
        normal = torch.where(hit, (rays.origins + depth * rays.directions) / SPHERE, 0.0)
        n = normal.numpy().astype(np.float64)
        color = torch.where(hit, torch.from_numpy(scene.radiance(n)).float(), 0.0)
        base_color = torch.where(
            hit, self.base_color_factor * torch.from_numpy(scene.base_color(n)).float(), 0.0
        )
        ones = hit.float()
        material = (base_color, scene.ROUGHNESS * ones, scene.METALLIC * ones)
        return Maps(color, color, color, torch.zeros_like(color), *material, normal, depth * ones, ones)

    def incident_light(self, x: torch.Tensor, wi: torch.Tensor) -> torch.Tensor:
        self.sizes.append(len(x))
        return self.light_factor * sky(wi)


def sky(wi: torch.Tensor) -> torch.Tensor:
    """Radiance that arrives from a direction in the scenes of these tests."""
    return 1.0 + 0.5 * wi


def make_run(capture, model: NeilfModel | None = None, step: int = 10**6, specular: bool = True) -> Run:
    config = preset("fast")
    config = dataclasses.replace(
        config,
        shading=dataclasses.replace(config.shading, specular=specular),
    )
    facts = SceneFacts("linear" if capture.hdr else "srgb", 0.5, 3.0, "none")
    return Run(Path("run"), config, capture, facts, (model or KnownSphere()).eval(), step)


@pytest.fixture(scope="module")
def captures(tmp_path_factory):
    root = tmp_path_factory.mktemp("captures")
    options = {"size": (160, 120), "views": 8, "test": (0, 5), "masks": True}
    return SimpleNamespace(
        hdr=scene.make_capture(root / "hdr", **options),
        ldr=scene.make_capture(root / "ldr", hdr=False, **options),
    )


@pytest.fixture(autouse=True)
def _few_points(monkeypatch):
    monkeypatch.setattr(scene_metrics, "SURFACE_POINTS", 20_000)
    monkeypatch.setattr(scene_metrics, "EVAL_RAYS", 1000)
    monkeypatch.setattr(views, "EVAL_RAYS", 1000)
    monkeypatch.setattr(scene_metrics, "MESH_RESOLUTION", 64)
    # The known sphere has no material field; test_confidence tests the confidence.
    monkeypatch.setattr(protocols, "confidence_metrics", lambda run, pairs: {})


# ----------------------------------------------------------------------------------------- a perfect estimate


def test_invalid_pixels_do_not_count(captures, tmp_path):
    capture = load_capture(shutil.copytree(captures.hdr, tmp_path / "hdr"))
    valid = np.full((120, 160), 255, np.uint8)
    valid[50:70, 60:100] = 0
    write_png(tmp_path / "hdr" / "valid.png", valid)
    for view in capture.test_views:
        pixels = read_image(view.image).pixels
        pixels[50:70, 60:100] = [np.nan, 9, 9]
        write_exr(view.image, {"RGB": pixels})
    views = tuple(dataclasses.replace(view, valid=tmp_path / "hdr" / "valid.png") for view in capture.views)
    run = make_run(dataclasses.replace(capture, views=views))
    figures = evaluate(run)
    assert figures["volume_psnr_linear"] > 90
    assert figures["normal_mae_deg"] < 0.1
    known = known_test_views(run, render_test_views(run)).views[0]
    colors = mean_observed_color(run.capture, surface_points(run.capture, known))
    assert np.isfinite(colors).all()


def test_a_perfect_estimate_scores_perfectly(captures):
    figures = evaluate(make_run(load_capture(captures.hdr)))
    eight_bit = (
        10 * math.log10(12 * 255**2) - 0.5
    )  # the 8-bit truth differs from the exact one by 1/(255 √12)
    assert {"chamfer", "chamfer_accuracy", "chamfer_completeness", "normal_mae_deg"} <= figures.keys()
    for name in ("volume_psnr", "pbr_psnr", "volume_psnr_linear", "pbr_psnr_linear"):
        assert figures[name] > 90, name
    for name in ("volume_ssim", "pbr_ssim"):
        assert figures[name] == pytest.approx(1.0, abs=1e-6), name
    for name in ("base_color_psnr", "base_color_psnr_scaled", "roughness_psnr", "metallic_psnr"):
        assert figures[name] > eight_bit, name
        assert figures[f"{name}_frame"] >= figures[name], name
    assert figures["base_color_psnr_gamma"] > 45
    assert figures["normal_mae_deg"] < 0.01
    # The true mesh has the chords of a sphere; 20,000 points on an area of 8 leave ½ √(8/20000) = 0.01 by
    # themselves.
    assert figures["chamfer"] < 0.013
    assert not any(name.startswith("incident_light") for name in figures)


def test_base_color_is_reported_with_and_without_alignment(captures):
    factor = 0.5
    figures = evaluate(make_run(load_capture(captures.hdr), KnownSphere(base_color_factor=factor)))
    capture = load_capture(captures.hdr)
    true = [
        Truth(capture).material(view).base_color[Truth(capture).mask(view)] for view in capture.test_views
    ]
    expected = np.mean([-10 * math.log10(((1 - factor) * t).square().mean()) for t in true])
    assert figures["base_color_psnr"] == pytest.approx(expected, abs=0.05)
    assert figures["base_color_psnr_scaled"] > 55
    assert expected < figures["base_color_psnr_gamma"] < 40


def test_frame_figures_differ_by_the_share_of_background(captures):
    capture = load_capture(captures.hdr)
    figures = evaluate(make_run(capture, KnownSphere(base_color_factor=0.5)))
    shares = [Truth(capture).mask(view).float().mean() for view in capture.test_views]
    gain = np.mean([-10 * math.log10(share) for share in shares])
    assert figures["base_color_psnr_frame"] - figures["base_color_psnr"] == pytest.approx(gain, abs=1e-4)


# --------------------------------------------------------------------------------------- only what is at hand


def test_an_ldr_capture_is_compared_in_display_values(captures):
    figures = evaluate(make_run(load_capture(captures.ldr)))
    assert figures["pbr_psnr"] > 10 * math.log10(12 * 255**2) - 0.5
    assert "pbr_psnr_linear" not in figures


def test_a_run_without_a_material_has_no_material_figures(captures):
    figures = evaluate(make_run(load_capture(captures.hdr), step=0))
    assert "volume_psnr" in figures
    assert "normal_mae_deg" in figures
    assert not [name for name in figures if name.startswith(("pbr", "base_color", "roughness", "metallic"))]


def test_a_lambertian_run_has_no_roughness(captures):
    figures = evaluate(make_run(load_capture(captures.hdr), specular=False))
    assert "base_color_psnr" in figures
    assert "roughness_psnr" not in figures


def test_without_truth_only_images_are_compared(captures, tmp_path):
    root = shutil.copytree(captures.hdr, tmp_path / "bare")
    shutil.rmtree(root / "ground_truths")
    for name in ("depth_maps", "normal_maps", "model", "masks"):
        shutil.rmtree(root / "inputs" / name)
    run = make_run(load_capture(root))
    assert protocol(run)["mask_source"] == "capture masks"  # the background of the capture is exactly black
    names = {"psnr", "psnr_linear", "ssim"}
    assert evaluate(run).keys() == {f"{kind}_{name}" for kind in ("volume", "pbr") for name in names}


def test_true_depth_selects_the_pixels_otherwise_the_masks(captures, tmp_path):
    assert protocol(make_run(load_capture(captures.hdr)))["mask_source"] == "true depth"
    root = shutil.copytree(captures.hdr, tmp_path / "masked")
    (root / "inputs" / "depth_maps" / "005.exr").unlink()  # if one depth map is missing, none is used
    run = make_run(load_capture(root))
    assert protocol(run)["mask_source"] == "capture masks"
    by_depth = known_test_views(make_run(load_capture(captures.hdr)), ()).views
    for known, other in zip(known_test_views(run, ()).views, by_depth, strict=True):
        assert np.array_equal(known.mask, other.mask)


def test_a_capture_without_test_views_is_refused(captures):
    loaded = load_capture(captures.hdr, test_every=0)
    with pytest.raises(UserError, match="no view is held out"):
        evaluate(make_run(loaded))
    with pytest.raises(UserError, match="train with --test-every 3"):
        evaluate(make_run(dataclasses.replace(loaded, views=loaded.views[:3])))


def test_images_smaller_than_the_window_have_no_ssim(tmp_path):
    figures = evaluate(make_run(load_capture(scene.make_capture(tmp_path / "tiny", size=(12, 9)))))
    assert "volume_psnr" in figures
    assert "volume_ssim" not in figures


# -------------------------------------------------------------------------------------------------- rendering


def test_whole_views_are_rendered_in_chunks(captures):
    capture = load_capture(captures.hdr)
    run = make_run(capture)
    view = render_view(run, 5)
    assert (view.name, view.maps["rgb"].shape, view.maps["depth"].shape) == (
        "005",
        (120, 160, 3),
        (120, 160, 1),
    )
    assert max(run.model.sizes) <= 1000
    assert sum(run.model.sizes) == 160 * 120
    # depth: the lengths of rays in scene units; the image's brightest pixel is where it should be
    assert view.maps["depth"].max() < scene.DISTANCE / scene.SCALE
    known = known_test_views(run, (view,)).views[1]
    assert np.abs(view.maps["rgb"] - known.image).max() < 1e-4


def test_progress_ends_at_one_and_views_can_be_shared(captures):
    run = make_run(load_capture(captures.hdr))
    rendered = render_test_views(run)
    shares: list[float] = []
    calls = len(run.model.sizes)
    assert evaluate(run, shares.append, rendered) == evaluate(run)
    assert shares == [1.0]
    assert len(run.model.sizes) == 2 * calls  # the first of the two calls rendered nothing
    evaluate(run, shares.append)
    assert shares[-1] == 1.0
    assert shares[1:] == sorted(shares[1:])


# --------------------------------------------------------------------------------------------------- baseline


def test_surface_points_lie_on_the_sphere(captures):
    run = make_run(load_capture(captures.hdr))
    for known in known_test_views(run, ()).views:
        points = surface_points(run.capture, known)
        assert points.shape == (known.mask.sum(), 3)
        assert points.norm(dim=-1).numpy() == pytest.approx(SPHERE, abs=1e-5)


@pytest.mark.parametrize("kind", ["hdr", "ldr"])
def test_the_observed_color_is_the_radiance_of_the_point(captures, kind):
    run = make_run(load_capture(getattr(captures, kind)))
    points = torch.cat([surface_points(run.capture, known) for known in known_test_views(run, ()).views])
    normal = points.double().numpy() / SPHERE
    sent = scene.radiance(normal)
    observed = mean_observed_color(run.capture, points)
    error = np.abs(observed - (sent if kind == "hdr" else sent.clip(0, 1))).max(-1)
    eyes = np.stack([view.camera.c2w[:, 3] - scene.CENTER for view in run.capture.train_views]) / scene.SCALE
    to_eyes = eyes - points.numpy()[:, None]
    cosines = (to_eyes * normal[:, None]).sum(-1) / np.linalg.norm(to_eyes, axis=-1)
    plain = cosines.max(-1) > 0.4  # the other points are visible only at grazing angles or not at all
    assert plain.mean() > 0.7
    # Pixels are 0.04 radii apart. A view from behind, taken for one that sees the point, would err by up to
    # 1.6.
    assert error[plain].max() < 0.05


def test_a_point_without_views_gets_the_mean_color(captures):
    capture = load_capture(captures.hdr)
    seen, hidden = torch.tensor([[SPHERE, 0.0, 0.0]]), torch.zeros(1, 3)
    observed = mean_observed_color(capture, torch.cat([seen, hidden]))
    assert observed[1] == pytest.approx(observed[0])


def test_baselines_use_the_same_pixels(captures):
    capture = load_capture(captures.hdr)
    run = make_run(capture)
    figures = evaluate(run)
    # The light is not white noise: colour seen is base colour times shading, so the baseline is far from
    # perfect.
    normals = [known.normal[known.mask].astype(np.float64) for known in known_test_views(run, ()).views]
    seen, true = [np.concatenate([f(n) for n in normals]) for f in (scene.radiance, scene.base_color)]
    scale = (seen * true).sum(0) / (seen * seen).sum(0)
    expected = np.mean(
        [-10 * np.log10(np.square(scene.radiance(n) * scale - scene.base_color(n)).mean()) for n in normals]
    )
    assert figures["baseline_base_color_psnr_scaled"] == pytest.approx(expected, abs=0.3)
    assert figures["baseline_roughness_psnr"] == pytest.approx(
        100.0
    )  # the sphere's roughness is one constant


# ------------------------------------------------------------------------------------------------------ light


def light_field(directions: list[list[float]], points: int = 2) -> LightField:
    """Points at the origin of a floor under `sky`."""
    unit = torch.nn.functional.normalize(torch.tensor(directions, dtype=torch.float32), dim=-1)
    wi, up = unit.repeat(points, 1, 1), torch.tensor([[0.0, 0.0, 1.0]]).repeat(points, 1)
    half = torch.full((points, 1), 0.5)
    return LightField(
        torch.zeros(points, 3), up, Material(half.expand(-1, 3), half, half), wi, sky(wi), wi, sky(wi)
    )


def test_light_that_is_too_bright_by_a_factor(captures):
    run = make_run(load_capture(captures.hdr), KnownSphere(light_factor=2.0))
    figures = light_metrics(run, light_field([[0, 0, 1], [1, 0, 1], [0, 1, 1]]), None)
    assert figures.keys() == {"incident_light_log_mae", "incident_light_log_mae_scaled"}
    assert figures["incident_light_log_mae"] == pytest.approx(math.log(2), abs=1e-3)
    assert figures["incident_light_log_mae_scaled"] == pytest.approx(0.0, abs=1e-3)


def test_occluded_directions_hit_the_scene(captures):
    # A roof one unit above the points, only on the side of +x.
    roof = Mesh(
        torch.tensor([[0.1, -5, 1], [9, -5, 1], [9, 5, 1], [0.1, 5, 1]]), torch.tensor([[0, 1, 2], [0, 2, 3]])
    )
    directions = [[1.0, 0, 1], [1, 1, 1], [-1, 0, 1], [-1, 1, 1], [-1, -1, 1]]
    field = light_field(directions)
    field.incident[:, :2] *= (
        math.e
    )  # true light is brighter than the estimate where the roof is, and only there
    figures = light_metrics(make_run(load_capture(captures.hdr)), field, roof)
    assert figures["incident_light_log_mae_occluded"] == pytest.approx(1.0, abs=2e-3)
    assert figures["incident_light_log_mae_occluded_scaled"] == pytest.approx(1.0, abs=2e-3)
    assert figures["incident_light_log_mae"] == pytest.approx(2 / 5, abs=1e-3)


def test_a_ray_does_not_hit_the_surface_at_its_start(captures):
    floor = Mesh(torch.tensor([[-5.0, -5, 0], [5, -5, 0], [0, 5, 0]]), torch.tensor([[0, 1, 2]]))
    run = make_run(load_capture(captures.hdr))
    assert "incident_light_log_mae_occluded" not in light_metrics(
        run, light_field([[0, 0, 1], [9, 0, 1]]), floor
    )


def test_the_light_field_of_a_capture_is_evaluated_in_chunks(captures, tmp_path):
    root = shutil.copytree(captures.hdr, tmp_path / "lit")
    field = light_field(torch.nn.functional.normalize(torch.randn(50_000, 3), dim=-1).tolist(), points=7)
    (root / "light").mkdir()
    arrays = {
        "points": field.position * scene.SCALE + torch.tensor(scene.CENTER).float(),
        "normals": field.normal,
    }
    arrays |= {"base_color": field.material.base_color, "roughness": torch.ones(7), "metallic": torch.ones(7)}
    arrays |= {"wi": field.wi, "incident": field.incident, "wo": field.wo, "outgoing": field.outgoing}
    np.savez(root / "light" / "light_field_gt.npz", **{name: array.numpy() for name, array in arrays.items()})
    run = make_run(load_capture(root))
    rendered = render_test_views(run)
    run.model.sizes.clear()
    assert evaluate(run, rendered=rendered)["incident_light_log_mae"] == pytest.approx(0.0, abs=1e-6)
    assert run.model.sizes == [2, 2, 2, 1]  # 1000 rays × 128 directions in flight


# ------------------------------------------------------------------------------------------------------- file


def test_metrics_are_flat_and_their_protocol_is_a_second_file(captures, tmp_path):
    run = make_run(load_capture(captures.hdr))
    path = tmp_path / "new" / "metrics.json"
    write_metrics(path, run, {"volume_psnr": 30.5})
    assert json.loads(path.read_text()) == {"volume_psnr": 30.5}
    assert json.loads((path.parent / "metrics-protocol.json").read_text())["mask_source"] == "true depth"
    with pytest.raises(ValueError, match="JSON"):
        write_metrics(path, run, {"volume_psnr": math.nan})
    assert json.loads(path.read_text())["volume_psnr"] == 30.5  # the old file is kept
    assert {p.name for p in path.parent.iterdir()} == {"metrics.json", "metrics-protocol.json"}
