"""Expected error of a run's material at surface points, from how well the training views determine it.

Two things stand between the images and the material. Noise, and what no model explains, is different in every
view; its size is that of the run's own residuals. Errors of the light are the same for all views of a point:
the radiance that arrives is uncertain patch of directions by patch, and as a whole. More views do not help
against those; a light that varies does, as does a lobe that moves across it. An error that all points have in
common is a scale of the base colour and no error, so each patch counts for what a point receives from it
more, or less, than a typical one (`Evidence.typical`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn import functional

from neilfpp_method.data.views import camera_rays
from neilfpp_method.evaluate.looks import possible_looks, sent_by_patch
from neilfpp_method.evaluate.patches import PATCHES, by_patch, light_by_patch, patch_count
from neilfpp_method.evaluate.posterior import Deviation, Sights, expected_error, guessed_error
from neilfpp_method.evaluate.sightings import Sightings, TrainingViews
from neilfpp_method.evaluate.views import RenderedView
from neilfpp_method.lighting.objective import error_unit
from neilfpp_method.model import NeilfModel
from neilfpp_method.shading.color import apply_response, response_slope, srgb_to_linear
from neilfpp_method.structures import OrientedPoints
from neilfpp_method.train.run import Run

__all__ = [
    "Evidence",
    "deviations_at",
    "gather_evidence",
    "material_deviation",
    "shown_surface",
    "with_deviation",
]

VIEWS = 16
"""Largest number of views of a point. Views between these add little information."""
DIRECT, REFLECTED, OVERALL = 0.3, 0.2, 1.0
"""Relative standard deviations of light from outside the scene, of light from its surfaces (which the cameras
see), and of a common factor on all light from outside, which nothing else fixes.
"""
KNOWN = 0.05
"""Relative standard deviation of a light that was given."""
PIXELS = 1024
"""Training pixels that measure how well the run explains its images, and the light at typical points."""
TYPICAL_LOOKS = 1
"""Prior views of a point: as many of typical error are added to the observed ones."""
POINTS_AT_ONCE, SIGHTED_AT_ONCE = 512, 2**16
"""Points that are shaded together, and points whose views are found together: bounds the memory."""
NEIGHBOURS, NEAR, TURN = 9, 0.1, 0.1
"""Largest neighbourhood of a point, itself included; its radius, scene units; what a radian between
normals adds to a distance, scene units.
"""
MIN_NOISE = 1e-3
"""Least typical relative error of the images."""
STEP = 1e-3
"""Difference of display values from which the slope of radiance over them is taken."""
TINY = 1e-9
"""Least divisor."""


@dataclass(frozen=True)
class Evidence:
    """What a run's images tell of any of its points.

    Attributes:
        views: the training views.
        noise: half of the relative errors of radiance are below it; they are relative to what was seen and a
            share of what is typical (`lighting.objective.FLOOR`).
        misfit: half of the points have a root mean square of their relative errors below it.
        typical: the mean over points of the shares of diffuse light that come from each patch.
    """

    views: TrainingViews
    noise: float
    misfit: float
    typical: Float[Tensor, "3 K"]


@torch.no_grad()
def gather_evidence(run: Run) -> Evidence:
    """Load a run's training views, and compare what they hold of some points with what the run shows of them.

    Where it shows no surface in any of them, the noise is as large as the pixels.

    Raises:
        UserError: there are no training views, or one cannot be read.
    """
    model = run.model
    views = TrainingViews(run.capture, next(model.parameters()).device)
    errors, misfits, shares = [], [], []
    pixels = views.evenly(PIXELS)
    for start in range(0, len(pixels), POINTS_AT_ONCE):
        hits = model.host.render(pixels[start : start + POINTS_AT_ONCE].rays)
        hits = hits[torch.nonzero(hits.is_hit(run.config.shading.hit_share))[:, 0]]
        normal = model.shading_normals(hits.position, hits.normal)
        seen = views.sightings(model, hits.position, normal, VIEWS)
        rows = torch.nonzero(seen.seen.any(1))[:, 0]
        if not len(rows):
            continue
        position, normal, seen = hits.position[rows], normal[rows], seen[rows]
        material = model.materials(position)
        incident = light_by_patch(model, position, normal, seen.wo, material)
        error = _relative_error(
            model, sent_by_patch(model, incident, material, normal, seen.wo).sum(-1), seen
        )
        errors.append(error[seen.seen].abs().flatten())
        misfits.append(_mean_over_looks(error.square(), seen).sqrt())
        parts = by_patch(incident.light, incident.patch, patch_count(model))
        shares.append(parts / parts.sum(-1, keepdim=True).clamp_min(TINY))
    if not errors:
        return Evidence(views, 1.0, 1.0, views.centres.new_zeros(3, patch_count(model)))
    noise, misfit = (max(torch.cat(values).median().item(), MIN_NOISE) for values in (errors, misfits))
    return Evidence(views, noise, misfit, torch.cat(shares).mean(0))


@torch.no_grad()
def material_deviation(
    model: NeilfModel,
    evidence: Evidence,
    position: Float[Tensor, "N 3"],
    normal: Float[Tensor, "N 3"],
    on_progress: Callable[[float], None] = lambda share: None,
) -> Deviation:
    """The expected errors of a model's material at surface points, the same at every call.

    Args:
        model: in evaluation mode.
        evidence: of the model's run.
        position: on the model's surface, scene frame.
        normal: unit, away from the surface.
        on_progress: told the share that is done.

    Returns:
        Root mean square errors, of each point the median of its neighbours' among these: base colour up to a
        factor per channel that is one for all points. Points that no view sees have those of a guess.
        Roughness and metallic mean nothing where the run's shading is Lambertian.
    """
    parts = [Deviation(*position.new_zeros(3, 0, 1))]
    for block in range(0, len(position), SIGHTED_AT_ONCE):
        end = min(block + SIGHTED_AT_ONCE, len(position))
        sightings = evidence.views.sightings(model, position[block:end], normal[block:end], VIEWS)
        for start in range(block, end, POINTS_AT_ONCE):
            rows = slice(start, min(start + POINTS_AT_ONCE, end))
            seen = sightings[rows.start - block : rows.stop - block]
            parts.append(_deviation(model, evidence, position[rows], normal[rows], seen))
            on_progress(rows.stop / len(position))
    deviation = Deviation(*(torch.cat([getattr(part, f.name) for part in parts]) for f in fields(Deviation)))
    return _evened(deviation, position, normal)


def deviations_at(run: Run, points: OrientedPoints) -> Float[Tensor, "N 3"]:
    """`material_deviation` of a run at points of its surface: of base colour, roughness and metallic."""
    deviation = material_deviation(run.model, gather_evidence(run), points.position, points.normal)
    return torch.cat([deviation.base_color, deviation.roughness, deviation.metallic], dim=-1)


def with_deviation(run: Run, evidence: Evidence, view: RenderedView, step: int = 1) -> RenderedView:
    """A rendered view with the maps base_color_std, roughness_std and metallic_std, 0 off the surface.

    With a `step` of k only every k-th pixel of every k-th row is asked, and the k × k about it take after it.
    A Lambertian run has the first map alone.
    """
    height, width = view.maps["opacity"].shape[:2]
    asked = np.zeros((height, width), bool)
    asked[::step, ::step] = view.maps["opacity"][::step, ::step, 0] > 0.5
    points = shown_surface(run, view, np.flatnonzero(asked))
    deviation = material_deviation(run.model, evidence, points.position, points.normal)
    maps = dict(view.maps)
    for name in ("base_color", "roughness", "metallic") if run.config.shading.specular else ("base_color",):
        values = np.zeros((height, width, 1), np.float32)
        values[asked] = getattr(deviation, name).cpu().numpy()
        maps[f"{name}_std"] = values[::step, ::step].repeat(step, 0).repeat(step, 1)[:height, :width]
    return replace(view, maps=maps)


def shown_surface(run: Run, view: RenderedView, pixels: Int[np.ndarray, " P"]) -> OrientedPoints:
    """The surface at pixels of a rendered view, counted row by row, on the device of the run's model."""
    camera = next(v.camera for v in run.capture.views if v.name == view.name)
    rays = camera_rays(run.capture.normalisation.camera(camera))[torch.from_numpy(pixels)]
    depth, normal = (
        torch.from_numpy(view.maps[name].reshape(-1, size)[pixels])
        for name, size in (("depth", 1), ("normal", 3))
    )
    return OrientedPoints(rays.origins + depth * rays.directions, normal).to(
        next(run.model.parameters()).device
    )


def _evened(deviation: Deviation, position: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"]) -> Deviation:
    """Medians over neighbours. Directions are drawn for each point by itself, and what the views of one point
    do not tell those of its neighbours may: the material is a field.
    """
    place = torch.cat((position, TURN * normal), -1).cpu().numpy()
    nearest = cKDTree(place).query(place, k=range(1, 1 + NEIGHBOURS), distance_upper_bound=NEAR)[1]
    # Where there are fewer, the tree says a row past the last.
    values = (
        functional.pad(getattr(deviation, f.name), (0, 0, 0, 1), value=math.nan)[nearest]
        for f in fields(Deviation)
    )
    return Deviation(*(value.nanmedian(1).values for value in values))


def _deviation(
    model: NeilfModel,
    evidence: Evidence,
    position: Float[Tensor, "N 3"],
    normal: Float[Tensor, "N 3"],
    seen: Sightings,
) -> Deviation:
    """Of points that are treated together."""
    material = model.materials(position)
    incident = light_by_patch(model, position, normal, seen.wo, material)
    sent = sent_by_patch(model, incident, material, normal, seen.wo)
    deviations = _light_deviations(model).to(sent)
    peculiar = sent - sent.sum(-1, keepdim=True) * evidence.typical
    outside = torch.cat((peculiar[..., :PATCHES], peculiar[..., 2 * PATCHES :]), -1).sum(-1, keepdim=True)
    shared = torch.cat((peculiar * deviations[:-1], outside * deviations[-1]), -1)
    sights = Sights(
        seen.seen, _to_radiance(model, seen.pixel), evidence.noise * _unit_error(model, seen.pixel), shared
    )
    looks = possible_looks(model, incident, normal, seen.wo)
    deviation = expected_error(looks, sights, material, model.config.shading.specular)
    return _widened(deviation, guessed_error(material), _birge_ratio(model, evidence, sent.sum(-1), seen))


def _birge_ratio(
    model: NeilfModel, evidence: Evidence, sent: Float[Tensor, "N V 3"], seen: Sightings
) -> Float[Tensor, "N 1"]:
    """How far off a point's own pixels are, against those of a typical point; 1 where nothing was seen."""
    off = (_relative_error(model, sent, seen) / evidence.misfit).square()
    looks = seen.seen.sum(1)
    return ((TYPICAL_LOOKS + looks * _mean_over_looks(off, seen)) / (TYPICAL_LOOKS + looks)).sqrt()[:, None]


def _widened(deviation: Deviation, guess: Deviation, ratio: Float[Tensor, "N 1"]) -> Deviation:
    """Deviations times the ratio, which makes none worse than a guess."""
    pairs = ((getattr(deviation, f.name), getattr(guess, f.name)) for f in fields(Deviation))
    return Deviation(*((own * ratio).minimum(own.maximum(worst)) for own, worst in pairs))


def _relative_error(
    model: NeilfModel, sent: Float[Tensor, "N V 3"], seen: Sightings
) -> Float[Tensor, "N V 3"]:
    """Of the radiance that a model sends towards views, against what they saw."""
    return (sent - _to_radiance(model, seen.pixel)) / _unit_error(model, seen.pixel)


def _mean_over_looks(values: Float[Tensor, "N V 3"], seen: Sightings) -> Float[Tensor, " N"]:
    """Over the channels of the views that saw a point; 0 where there is none."""
    return (values.mean(-1) * seen.seen).sum(1) / seen.seen.sum(1).clamp_min(1)


def _light_deviations(model: NeilfModel) -> Float[Tensor, " E"]:
    """Of each patch, and last of all light from outside together."""
    known = model.config.known_map is not None
    direct, overall = (KNOWN, KNOWN) if known else (DIRECT, OVERALL)
    lamps = patch_count(model) - 2 * PATCHES
    return torch.tensor([direct] * PATCHES + [REFLECTED] * PATCHES + [DIRECT] * lamps + [overall])


def _unit_error(model: NeilfModel, pixel: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
    """The radiance that a relative error of 1 means at a pixel, as in fits of the light (`Objective`)."""
    response = model.facts.response
    typical = apply_response(torch.tensor(model.facts.median_radiance), response)
    unit = error_unit(pixel, response, response_slope(typical, response).item())
    if response == "linear":
        return unit
    return unit * (srgb_to_linear(pixel + STEP) - srgb_to_linear(pixel)) / STEP


def _to_radiance(model: NeilfModel, pixel: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
    return pixel if model.facts.response == "linear" else srgb_to_linear(pixel)
