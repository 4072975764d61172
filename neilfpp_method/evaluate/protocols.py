"""What is measured of a run, and how (METHOD §8): the metrics put together into the figures that tables hold.

An image metric is taken per view and averaged over the test views. A figure is there when its truth is at
hand and the run has an estimate of it. Alignments are never silent: each has a key of its own beside the
figure without it.

    volume_psnr, pbr_psnr, *_ssim     R and the rendering equation against the image, clipped, sRGB-encoded
    *_psnr_linear                     the same on linear radiance, peak 1, HDR captures
    *_psnr_exposed                    with the least-squares gain of each new view and channel, where
                                      photographs have gains
    base_color_psnr, _gamma, _scaled  as estimated; with one gamma; with a least-squares factor per channel
    roughness_psnr, metallic_psnr     as estimated
    *_frame                           the same over the whole frame, the background counted as free of error
    normal_mae_deg                    mean angle where the truth and the estimate have a normal, degrees
    chamfer, _accuracy, _completeness scene units
    incident_light_log_mae            mean |ln L − ln L_true| over points and directions of the true field
      _occluded, _scaled              over directions that meet the scene; up to a factor per channel
    confidence_*_ratio                mean error of the half of the pixels with the smallest expected error,
                                      over that of the other half; base colour scaled
    baseline_*                        what needs no method, on the same pixels
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.mesh import Mesh
from neilfpp_method.data.truth import LightField, Truth
from neilfpp_method.evaluate import metrics
from neilfpp_method.evaluate.confidence import gather_evidence, material_deviation, shown_surface
from neilfpp_method.evaluate.size import what_is_measured
from neilfpp_method.evaluate.views import (
    KnownView,
    RenderedView,
    known_test_views,
    mask_source,
    mean_observed_color,
    render_test_views,
    surface_points,
)
from neilfpp_method.export.mesh import extract_mesh
from neilfpp_method.health.cases import verdict_of
from neilfpp_method.hosts.base import HasSdf
from neilfpp_method.hosts.volsdf import HIT_RADIUS
from neilfpp_method.shading.color import CLIPPED, srgb_to_linear, tone_map
from neilfpp_method.train.health_record import read_findings
from neilfpp_method.train.run import Run, write_json

__all__ = ["evaluate", "protocol", "write_metrics"]

RENDERING = 0.9
"""Share of the work that is rendering the test views, for the progress bar."""
SURFACE_POINTS = 500_000
"""Points on each surface for Chamfer distances. Sampling alone gives a mean of ½ √(area / points)."""
MESH_RESOLUTION = 256
"""Cells along an edge of the grid from which the estimated surface is extracted."""
CONFIDENCE_PIXELS = 8192
"""Evenly spread test pixels whose error is compared with the expected error."""
MARGIN = 0.05
"""Share of the diagonal of the truth's bounding box by which the box is enlarged. The estimate counts within
it; beyond, where no image looks, a distance field closes its surface arbitrarily.
"""
OFFSET = 1e-3
"""Height above the surface, scene units, at which visibility rays start."""

Pairs = Sequence[tuple[RenderedView, KnownView]]


def evaluate(
    run: Run,
    on_progress: Callable[[float], None] = lambda share: None,
    rendered: Sequence[RenderedView] | None = None,
) -> dict[str, float]:
    """Every figure that the capture's truth allows, by name.

    Args:
        run: the trained run.
        on_progress: called with the share of the work that is done.
        rendered: the test views of the run in order, where somebody has rendered them already.

    Raises:
        UserError: no view is held out, a file of the truth is damaged, or the run has no surface to compare.
    """
    rendered = rendered or render_test_views(run, lambda share: on_progress(RENDERING * share))
    known = known_test_views(run, rendered)
    pairs = [(r, k) for r, k in zip(rendered, known.views, strict=True) if k.mask.any()]
    figures = image_metrics(run, pairs) | material_metrics(run, pairs) | normal_metrics(pairs)
    figures |= confidence_metrics(run, pairs) | baseline_metrics(run.capture, pairs)
    truth = Truth(run.capture)
    mesh, light = truth.mesh(), truth.light_field()
    if mesh is not None and isinstance(run.model.host, HasSdf):
        figures |= chamfer_metrics(run, mesh)
    if light is not None and run.has_material:
        figures |= light_metrics(run, light, mesh)
    on_progress(1.0)
    return figures


def protocol(run: Run) -> dict[str, str]:
    """How the figures of a run are to be read, in words: above all, what chose the pixels that count."""
    return {
        "mask_source": mask_source(run.capture),
        "average": "per view over its masked pixels, then over the test views",
        "peak": "1",
        "light_log_floor": f"{metrics.LOG_FLOOR:g}",
    }


def write_metrics(path: Path, run: Run, figures: Mapping[str, float]) -> None:
    """Write the figures and the verdict on the run's health as a flat JSON object.

    Beside it, as `<stem>-protocol.json`, stands how to read them, and what was measured.
    """
    findings = read_findings(run.path)
    health = {} if findings is None else {"health": verdict_of(findings)}
    write_json(path, {**figures, **health})
    described = {**protocol(run), "measured": what_is_measured(run)}
    write_json(path.with_name(f"{path.stem}-protocol.json"), described)


# ---------------------------------------------------------------------------------- images, material, normals


class Scores(defaultdict[str, list[float]]):
    """Figures of single views by name, and their means over the views that have them."""

    def __init__(self) -> None:
        super().__init__(list)

    def means(self) -> dict[str, float]:
        kept = {name: [v for v in values if not np.isnan(v)] for name, values in self.items()}
        return {name: float(np.mean(values)) for name, values in kept.items() if values}


def image_metrics(run: Run, pairs: Pairs) -> dict[str, float]:
    """PSNR and SSIM of what R and what the rendering equation show; the second once there is a material."""
    shown = {"volume": "rgb_volume"} | ({"pbr": "rgb"} if run.has_material else {})
    scores = Scores()
    for view, known in pairs:
        image = _tone_mapped(known.image) if run.capture.hdr else known.image
        for name, key in shown.items():
            estimate = _tone_mapped(view.maps[key])
            scores[f"{name}_psnr"].append(metrics.psnr(estimate, image, known.mask))
            if min(known.mask.shape) >= metrics.SSIM_WINDOW:
                scores[f"{name}_ssim"].append(metrics.ssim(estimate, image, known.mask))
            if run.model.gains is not None:
                exposed = exposed_alike(view.maps[key], known.image, known.mask, run.facts.response)
                scores[f"{name}_psnr_exposed"].append(metrics.psnr(_tone_mapped(exposed), image, known.mask))
            if run.capture.hdr:
                scores[f"{name}_psnr_linear"].append(metrics.psnr(view.maps[key], known.image, known.mask))
    return scores.means()


def exposed_alike(
    estimate: Float[np.ndarray, "H W 3"],
    image: Float[np.ndarray, "H W 3"],
    mask: Bool[np.ndarray, "H W"],
    response: str,
) -> Float[np.ndarray, "H W 3"]:
    """Radiance as the camera of a view saw it: times one factor per channel, the best in least squares of
    linear values over the masked pixels that are not clipped. A new view has a gain that no training knows.
    """
    pixels = image[mask].astype(np.float64)
    counts = np.ones(len(pixels), dtype=bool)
    if response == "srgb":
        counts = pixels.max(-1) < CLIPPED
        pixels = srgb_to_linear(torch.from_numpy(pixels)).numpy()
    gain = metrics.align_scale(estimate[mask][counts], pixels[counts])
    return (estimate * gain).astype(np.float32)


def material_metrics(run: Run, pairs: Pairs) -> dict[str, float]:
    """PSNR of the material maps, of the base colour under three alignments.

    Both alignments are one for all test views. A Lambertian run estimates neither roughness nor metallic.
    """
    pairs = [(view, known) for view, known in pairs if known.material is not None]
    if not pairs or not run.has_material:
        return {}
    estimate = np.concatenate([view.maps["base_color"][known.mask] for view, known in pairs])
    true = _pooled(pairs, "base_color")
    gamma, scale = metrics.align_gamma(estimate, true), metrics.align_scale(estimate, true)
    scores = Scores()
    for view, known in pairs:
        base_color = view.maps["base_color"]
        estimates = {
            "base_color_psnr": ("base_color", base_color),
            "base_color_psnr_gamma": ("base_color", base_color**gamma),
            "base_color_psnr_scaled": ("base_color", base_color * scale),
        }
        if run.config.shading.specular:
            estimates |= {f"{name}_psnr": (name, view.maps[name]) for name in ("roughness", "metallic")}
        for key, (name, values) in estimates.items():
            scores[key].append(metrics.psnr(values, known.material[name], known.mask))
            scores[f"{key}_frame"].append(metrics.psnr_frame(values, known.material[name], known.mask))
    return scores.means()


def confidence_metrics(run: Run, pairs: Pairs) -> dict[str, float]:
    """Whether the run knows where its material is wrong; absent where the other half is without error."""
    pairs = [(view, known) for view, known in pairs if known.material is not None]
    if not pairs or not run.has_material or not run.capture.train_views:
        return {}
    rows = [np.flatnonzero(known.mask & (view.maps["opacity"][..., 0] > 0.5)) for view, known in pairs]
    step = max(1, sum(map(len, rows)) // CONFIDENCE_PIXELS)
    rows = [r[::step] for r in rows]
    points = [shown_surface(run, view, r) for (view, _), r in zip(pairs, rows, strict=True)]
    position, normal = (torch.cat([getattr(p, name) for p in points]) for name in ("position", "normal"))
    deviation = material_deviation(run.model, gather_evidence(run), position, normal)

    figures = {}
    for name in ("base_color", "roughness", "metallic") if run.config.shading.specular else ("base_color",):
        estimate, true = (
            np.concatenate(
                [maps[name].reshape(-1, maps[name].shape[-1])[r] for maps, r in zip(side, rows, strict=True)]
            )
            for side in ([view.maps for view, _ in pairs], [known.material for _, known in pairs])
        )
        scale = metrics.align_scale(estimate, true) if name == "base_color" else 1.0
        error = np.abs(estimate * scale - true).mean(-1)
        ratio = metrics.confidence_ratio(error, getattr(deviation, name)[:, 0].cpu().numpy())
        if ratio is not None:
            figures[f"confidence_{name}_ratio"] = ratio
    return figures


def normal_metrics(pairs: Pairs) -> dict[str, float]:
    """The mean angle between normals."""
    scores = Scores()
    for view, known in pairs:
        if known.normal is not None:
            scores["normal_mae_deg"].append(
                metrics.angular_error(view.maps["normal"], known.normal, known.mask)
            )
    return scores.means()


def _tone_mapped(color: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W 3"]:
    return tone_map(torch.from_numpy(color)).numpy()


def _pooled(pairs: Pairs, name: str) -> Float[np.ndarray, "P C"]:
    """True material of all masked test pixels."""
    return np.concatenate([known.material[name][known.mask] for _, known in pairs])


# --------------------------------------------------------------------------------------------------- geometry


def chamfer_metrics(run: Run, truth: Mesh) -> dict[str, float]:
    """Chamfer distance between the run's surface and the true mesh, scene units.

    Both are sampled by area; the estimate within `MARGIN` of the truth's box. Absent where none is.
    """
    true = trimesh.Trimesh(truth.vertices.numpy(), truth.faces.numpy(), process=False)
    margin = MARGIN * np.linalg.norm(true.extents)
    low, high = true.bounds[0] - margin, true.bounds[1] + margin
    volume = run.config.volume
    corner = np.linalg.norm(np.maximum(np.abs(low), np.abs(high)))
    device = next(run.model.parameters()).device
    # The sphere that may close the scene is no surface of the object; far parts are cut anyway.
    radius = min(float(corner), volume.radius - HIT_RADIUS)
    surface = extract_mesh(run.model.host.sdf, radius, MESH_RESOLUTION, device=device)
    points = metrics.sample_surface(surface, SURFACE_POINTS)
    points = points[((points >= low) & (points <= high)).all(axis=-1)]
    if not len(points):
        return {}
    distances = metrics.chamfer(points, metrics.sample_surface(true, SURFACE_POINTS))
    return {
        "chamfer": distances.mean,
        "chamfer_accuracy": distances.accuracy,
        "chamfer_completeness": distances.completeness,
    }


# ------------------------------------------------------------------------------------------------------ light


def light_metrics(run: Run, field: LightField, mesh: Mesh | None) -> dict[str, float]:
    """Log errors of the incident light at the points of a true light field.

    Images determine light only up to a factor that the base colour takes up; `_scaled` removes the median log
    ratio of each channel, one for all points and directions.
    """
    ratio = metrics.log_ratio(
        _incident_light(run, field).reshape(-1, 3), field.incident.reshape(-1, 3).numpy()
    )
    scaled = ratio - np.median(ratio, axis=0)
    name = "incident_light_log_mae"
    figures = {name: metrics.log_error(ratio), f"{name}_scaled": metrics.log_error(scaled)}
    occluded = np.zeros(len(ratio), bool) if mesh is None else _occluded(field, mesh)
    if occluded.any():
        figures[f"{name}_occluded"] = metrics.log_error(ratio[occluded])
        figures[f"{name}_occluded_scaled"] = metrics.log_error(scaled[occluded])
    return figures


@torch.no_grad()
def _incident_light(run: Run, field: LightField) -> Float[np.ndarray, "N S 3"]:
    device = next(run.model.parameters()).device
    in_flight = run.config.train.eval_chunk * run.config.shading.eval_samples
    points = max(1, in_flight // field.wi.shape[1])
    chunks = zip(field.position.split(points), field.wi.split(points), strict=True)
    return torch.cat(
        [run.model.incident_light(x.to(device), wi.to(device)).cpu() for x, wi in chunks]
    ).numpy()


def _occluded(field: LightField, mesh: Mesh) -> Bool[np.ndarray, " P"]:
    """Which directions of the field, flat, meet the scene again."""
    surface = trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)
    origins = (field.position + OFFSET * field.normal)[:, None].expand_as(field.wi)
    return surface.ray.intersects_any(origins.reshape(-1, 3).numpy(), field.wi.reshape(-1, 3).numpy())


# -------------------------------------------------------------------------------------------------- baselines


def baseline_metrics(capture: Capture, pairs: Pairs) -> dict[str, float]:
    """Guesses that take no method, for a method to beat.

    Base colour is the mean colour that the training views saw of the point, with the best factor per channel;
    roughness and metallic are constants, the true means. All three are generous: the truth has a say in them.
    """
    pairs = [(view, known) for view, known in pairs if known.material is not None]
    if not pairs:
        return {}
    scores = Scores()
    for name in ("roughness", "metallic"):
        constant = _pooled(pairs, name).mean()
        for _, known in pairs:
            true = known.material[name]
            scores[f"baseline_{name}_psnr"].append(
                metrics.psnr(np.full_like(true, constant), true, known.mask)
            )
    if all(known.depth is not None for _, known in pairs):
        observed = mean_observed_color(
            capture, torch.cat([surface_points(capture, known) for _, known in pairs])
        )
        if observed is not None:
            aligned = observed * metrics.align_scale(observed, _pooled(pairs, "base_color"))
            ends = np.cumsum([known.mask.sum() for _, known in pairs])[:-1]
            for part, (_, known) in zip(np.split(aligned, ends), pairs, strict=True):
                guess = np.zeros(known.image.shape)
                guess[known.mask] = part
                score = metrics.psnr(guess, known.material["base_color"], known.mask)
                scores["baseline_base_color_psnr_scaled"].append(score)
    return scores.means()
