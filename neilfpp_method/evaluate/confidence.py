"""Expected error of a run's material at surface points, from how well the training views determine it.

The error model has two parts:

- Errors that are independent between views: noise, and residuals that the model does not explain. Their size
  is measured from the run's own residuals.
- Errors of the estimated light, which all views of a point share. The incident radiance is uncertain per
  patch of directions, and by a common factor. More views do not reduce these errors. They are smaller if the
  light varies over directions, and if the specular lobes of different views cover different parts of it.

An error that all points share is a scale of the base colour, which no image can determine and which is not
counted. Each patch therefore contributes in proportion to the difference between the share of light that a
point receives from it and the share that a typical point receives (`TrainingResiduals.typical`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from neilfpp_method.data.cameras.projection import camera_rays
from neilfpp_method.data.kd_tree import kd_tree
from neilfpp_method.evaluate.outgoing import radiance_parts, sent_by_patch
from neilfpp_method.evaluate.patches import PATCHES, by_patch, light_by_patch, patch_count
from neilfpp_method.evaluate.posterior import Deviation, Observations, expected_error, prior_error
from neilfpp_method.evaluate.sightings import Sightings, TrainingViews
from neilfpp_method.evaluate.views import RenderedView
from neilfpp_method.lighting.objective import error_unit
from neilfpp_method.model import NeilfModel
from neilfpp_method.shading.color import apply_response, response_slope, srgb_to_linear
from neilfpp_method.structures import OrientedPoints
from neilfpp_method.train.run import Run

__all__ = [
    "DISPLAY_STEP",
    "TrainingResiduals",
    "coordinates",
    "deviations_at",
    "material_deviation",
    "measure_residuals",
    "surface_at_pixels",
    "with_deviation",
]

DISPLAY_STEP = 2
"""Step of `with_deviation` for images that are only displayed: a quarter of the time."""
VIEWS = 16
"""Largest number of training views used per point. Further views lie between these and add little."""
DIRECT, REFLECTED, OVERALL = 0.3, 0.2, 1.0
"""Relative standard deviations of: light from outside the scene, per patch; light from surfaces of the scene,
which is smaller because cameras observe those surfaces; and a common factor on all light from outside, which
the images do not determine.
"""
KNOWN_MAP_DEVIATION = 0.05
"""Relative standard deviation of light from outside the scene if the environment map was given."""
PIXELS = 1024
"""Number of training pixels from which `TrainingResiduals` are computed."""
PRIOR_VIEWS = 1
"""Weight of the prior in `_birge_ratio`: this many views of typical error are added to the observed ones."""
POINTS_AT_ONCE, SIGHTED_AT_ONCE = 512, 2**16
"""Batch sizes, which bound the memory: points that are shaded together, and points whose views are searched
together.
"""
NEIGHBORS, NEAR, TURN = 9, 0.1, 0.1
"""Neighbourhood of a point in `_smoothed`: its largest size, the point included; its radius, scene units; and
the distance, scene units, that one radian between two normals adds.
"""
MIN_NOISE = 1e-3
"""Lower bound of the measured relative errors, so that a perfect fit does not divide by zero."""
STEP = 1e-3
"""Step, in display values, of the finite difference that gives the slope of radiance over display values."""
TINY = 1e-9
"""Smallest divisor."""


@dataclass(frozen=True)
class TrainingResiduals:
    """Training views of a run and statistics of how well the run reproduces them.

    Attributes:
        views: the training views.
        noise: median absolute relative error of radiance over pixels. The error is divided by the observed
            radiance plus a fraction of the typical radiance (`lighting.objective.ERROR_FLOOR`).
        misfit: median over points of the root mean square relative error over the views of a point.
        typical: share of the diffuse light that comes from each of K patches, per colour channel, averaged
            over points.
    """

    views: TrainingViews
    noise: float
    misfit: float
    typical: Float[Tensor, "3 K"]


@torch.no_grad()
def measure_residuals(run: Run) -> TrainingResiduals:
    """Load a run's training views and compare about `PIXELS` of their pixels with the rendering equation.

    If the run shows no surface in any training view, `noise` and `misfit` are 1: errors as large as the
    radiance.

    Raises:
        UserError: there are no training views, or one cannot be read.
    """
    model = run.model
    views = TrainingViews(run.capture, run.device)
    errors, misfits, shares = [], [], []
    pixels = views.evenly_spaced_pixels(PIXELS)
    for start in range(0, len(pixels), POINTS_AT_ONCE):
        hits = model.host.render(pixels[start : start + POINTS_AT_ONCE].rays)
        hits = hits[torch.nonzero(hits.is_hit(run.config.shading.hit_share))[:, 0]]
        normal = model.shading_normals(hits.position, hits.normal)
        sightings = views.sightings(model, hits.position, normal, VIEWS)
        rows = torch.nonzero(sightings.visible.any(1))[:, 0]
        if not len(rows):
            continue
        position, normal, sightings = hits.position[rows], normal[rows], sightings[rows]
        material = model.materials(position)
        incident = light_by_patch(model, position, normal, sightings.wo, material)
        error = _relative_error(
            model, sent_by_patch(model, incident, material, normal, sightings.wo).sum(-1), sightings
        )
        errors.append(error[sightings.visible].abs().flatten())
        misfits.append(_mean_over_views(error.square(), sightings).sqrt())
        parts = by_patch(incident.light, incident.patch, patch_count(model))
        shares.append(parts / parts.sum(-1, keepdim=True).clamp_min(TINY))
    if not errors:
        return TrainingResiduals(views, 1.0, 1.0, views.centers.new_zeros(3, patch_count(model)))
    noise, misfit = (max(torch.cat(values).median().item(), MIN_NOISE) for values in (errors, misfits))
    return TrainingResiduals(views, noise, misfit, torch.cat(shares).mean(0))


@torch.no_grad()
def material_deviation(
    model: NeilfModel,
    residuals: TrainingResiduals,
    position: Float[Tensor, "N 3"],
    normal: Float[Tensor, "N 3"],
    on_progress: Callable[[float], None] = lambda share: None,
) -> Deviation:
    """Estimate the error of a model's material at surface points. Deterministic.

    Args:
        model: the model, in evaluation mode.
        residuals: how well the model's run reproduces its training views (`measure_residuals`).
        position: points on the model's surface, scene frame.
        normal: unit normals, away from the surface.
        on_progress: called with the fraction of the work that is done.

    Returns:
        Expected root mean square errors, smoothed by a median over neighbouring points. The error of base
        colour does not include a factor per channel that all points share. A point that no view sees has the
        error of a guess (`posterior.prior_error`). If the run's shading is Lambertian, the values for
        roughness and metallic are meaningless.
    """
    parts = [Deviation(*position.new_zeros(3, 0, 1))]
    for block in range(0, len(position), SIGHTED_AT_ONCE):
        end = min(block + SIGHTED_AT_ONCE, len(position))
        block_sightings = residuals.views.sightings(model, position[block:end], normal[block:end], VIEWS)
        for start in range(block, end, POINTS_AT_ONCE):
            rows = slice(start, min(start + POINTS_AT_ONCE, end))
            sightings = block_sightings[rows.start - block : rows.stop - block]
            parts.append(_deviation(model, residuals, position[rows], normal[rows], sightings))
            on_progress(rows.stop / len(position))
    return _smoothed(Deviation.joined(parts), position, normal)


def deviations_at(run: Run, points: OrientedPoints) -> Float[Tensor, "N 3"]:
    """`material_deviation` at points of a run; the columns are base colour, roughness, metallic."""
    deviation = material_deviation(run.model, measure_residuals(run), points.position, points.normal)
    return torch.cat([deviation.base_color, deviation.roughness, deviation.metallic], dim=-1)


def with_deviation(run: Run, residuals: TrainingResiduals, view: RenderedView, step: int = 1) -> RenderedView:
    """Add the maps base_color_std, roughness_std and metallic_std to a rendered view; 0 off the surface.

    With a `step` of k only every k-th pixel of every k-th row is computed, and each result fills a block of
    k × k pixels. A Lambertian run gets base_color_std only.
    """
    height, width = view.maps["opacity"].shape[:2]
    computed = np.zeros((height, width), bool)
    computed[::step, ::step] = view.maps["opacity"][::step, ::step, 0] > 0.5
    points = surface_at_pixels(run, view, np.flatnonzero(computed))
    deviation = material_deviation(run.model, residuals, points.position, points.normal)
    maps = dict(view.maps)
    for name in ("base_color", "roughness", "metallic") if run.config.shading.specular else ("base_color",):
        values = np.zeros((height, width, 1), np.float32)
        values[computed] = getattr(deviation, name).cpu().numpy()
        maps[f"{name}_std"] = values[::step, ::step].repeat(step, 0).repeat(step, 1)[:height, :width]
    return replace(view, maps=maps)


def surface_at_pixels(run: Run, view: RenderedView, pixels: Int[np.ndarray, " P"]) -> OrientedPoints:
    """Position and normal of the surface at pixels of a rendered view, on the device of the run's model.

    Args:
        run: the run that rendered the view.
        view: the rendered view.
        pixels: row-major pixel indices.
    """
    camera = next(v.camera for v in run.capture.views if v.name == view.name)
    rays = camera_rays(run.capture.normalization.camera(camera))[torch.from_numpy(pixels)]
    depth = torch.from_numpy(view.maps["depth"].reshape(-1, 1)[pixels])
    normal = torch.from_numpy(view.maps["normal"].reshape(-1, 3)[pixels])
    points = OrientedPoints(rays.origins + depth * rays.directions, normal)
    return points.to(run.device)


def coordinates(position: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"]) -> Float[np.ndarray, "N 6"]:
    """Coordinates for the search of neighbours: positions, scene frame, and `TURN` times the unit normals.

    The two sides of a thin plate are far from each other in them.
    """
    return torch.cat((position, TURN * normal), -1).cpu().numpy()


def _smoothed(
    deviation: Deviation, position: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"]
) -> Deviation:
    """Take the median over the neighbours of each point.

    Directions are sampled for each point separately, so single values are noisy. Also, the material is a
    continuous field: views of neighbouring points constrain a point that its own views do not.
    """
    places = coordinates(position, normal)
    nearest = kd_tree(places).query(places, k=range(1, 1 + NEIGHBORS), distance_upper_bound=NEAR)[1]
    # If a point has fewer neighbours, the tree returns the index after the last row; that row is padded
    # with NaN here, which nanmedian ignores.
    values = (
        functional.pad(getattr(deviation, f.name), (0, 0, 0, 1), value=math.nan)[nearest]
        for f in fields(Deviation)
    )
    return Deviation(*(value.nanmedian(1).values for value in values))


def _deviation(
    model: NeilfModel,
    residuals: TrainingResiduals,
    position: Float[Tensor, "N 3"],
    normal: Float[Tensor, "N 3"],
    sightings: Sightings,
) -> Deviation:
    """Expected errors of one batch of points, not smoothed."""
    material = model.materials(position)
    incident = light_by_patch(model, position, normal, sightings.wo, material)
    sent = sent_by_patch(model, incident, material, normal, sightings.wo)
    deviations = _light_deviations(model).to(sent)
    atypical = sent - sent.sum(-1, keepdim=True) * residuals.typical
    outside = torch.cat((atypical[..., :PATCHES], atypical[..., 2 * PATCHES :]), -1).sum(-1, keepdim=True)
    observations = Observations(
        visible=sightings.visible,
        radiance=_to_radiance(model, sightings.pixel),
        noise=residuals.noise * _unit_error(model, sightings.pixel),
        shared=torch.cat((atypical * deviations[:-1], outside * deviations[-1]), -1),
    )
    parts = radiance_parts(model, incident, normal, sightings.wo)
    deviation = expected_error(parts, observations, material, model.config.shading.specular)
    return _widened(deviation, prior_error(material), _birge_ratio(model, residuals, sent.sum(-1), sightings))


def _birge_ratio(
    model: NeilfModel, residuals: TrainingResiduals, sent: Float[Tensor, "N V 3"], sightings: Sightings
) -> Float[Tensor, "N 1"]:
    """Ratio of a point's root mean square residual to that of a typical point; 1 if no view sees the point.

    Expected errors are multiplied by it, as measurements that disagree more than their errors allow are in
    the method of Birge (Physical Review 40, 1932).
    """
    error = (_relative_error(model, sent, sightings) / residuals.misfit).square()
    views = sightings.visible.sum(1)
    mean = (PRIOR_VIEWS + views * _mean_over_views(error, sightings)) / (PRIOR_VIEWS + views)
    return mean.sqrt()[:, None]


def _widened(deviation: Deviation, guess: Deviation, ratio: Float[Tensor, "N 1"]) -> Deviation:
    """Multiply deviations by the ratio, but do not raise any above that of a guess."""
    pairs = ((getattr(deviation, f.name), getattr(guess, f.name)) for f in fields(Deviation))
    return Deviation(*((own * ratio).minimum(own.maximum(worst)) for own, worst in pairs))


def _relative_error(
    model: NeilfModel, sent: Float[Tensor, "N V 3"], sightings: Sightings
) -> Float[Tensor, "N V 3"]:
    """Relative error of the radiance that the model sends towards each view, against the observed pixel."""
    return (sent - _to_radiance(model, sightings.pixel)) / _unit_error(model, sightings.pixel)


def _mean_over_views(values: Float[Tensor, "N V 3"], sightings: Sightings) -> Float[Tensor, " N"]:
    """Mean over the channels and the views that see a point; 0 if there is no such view."""
    return (values.mean(-1) * sightings.visible).sum(1) / sightings.visible.sum(1).clamp_min(1)


def _light_deviations(model: NeilfModel) -> Float[Tensor, " E"]:
    """Relative standard deviations of the light: one for each patch, then that of the common factor."""
    known = model.config.known_map is not None
    direct, overall = (KNOWN_MAP_DEVIATION, KNOWN_MAP_DEVIATION) if known else (DIRECT, OVERALL)
    lamps = patch_count(model) - 2 * PATCHES
    return torch.tensor([direct] * PATCHES + [REFLECTED] * PATCHES + [DIRECT] * lamps + [overall])


def _unit_error(model: NeilfModel, pixel: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
    """Radiance that corresponds to a relative error of 1 at a pixel, as in the light fit (`Objective`)."""
    response = model.facts.response
    typical = apply_response(torch.tensor(model.facts.median_radiance), response)
    unit = error_unit(pixel, response, response_slope(typical, response).item())
    if response == "linear":
        return unit
    return unit * (srgb_to_linear(pixel + STEP) - srgb_to_linear(pixel)) / STEP


def _to_radiance(model: NeilfModel, pixel: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
    return pixel if model.facts.response == "linear" else srgb_to_linear(pixel)
