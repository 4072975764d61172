"""How far off a run's material may be at points of its surface, from how well what the training views saw determines it.

Two things stand between the images and the material. Noise, and what no model explains, is different in every view; its size
is that of the run's own residuals. Errors of the light are the same for all views of a point: the radiance that arrives is
uncertain patch of directions by patch, and as a whole. More views do not help against those; a light that varies does, as
does a lobe that moves across it. An error that all points have in common is a scale of the base colour and no error, so each
patch counts for what a point receives from it more, or less, than a typical one (`Evidence.typical`).
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
from neilfpp_method.evaluate.arriving import PATCHES, arriving_light, by_patch, patch_count
from neilfpp_method.evaluate.posterior import ROUGHNESS_NODES, Deviation, Looks, Sights, expected_error
from neilfpp_method.evaluate.sightings import Sightings, TrainingViews
from neilfpp_method.evaluate.views import RenderedView
from neilfpp_method.model import NeilfModel
from neilfpp_method.shading.brdf import cosines, diffuse_reflectance, normal_reflectance
from neilfpp_method.shading.color import apply_response, srgb_to_linear
from neilfpp_method.structures import OrientedPoints
from neilfpp_method.train.run import Run

__all__ = ["Evidence", "gather_evidence", "material_deviation", "shown_surface", "with_deviation"]

VIEWS = 16
"""Views of a point that count. Those that lie between them add little that is new."""
DIRECT, REFLECTED, OVERALL = 0.3, 0.2, 1.0
"""Relative standard deviations of the light of a patch, or a lamp: from outside the scene, from its own surfaces, whose
radiance the cameras see, and of all light from outside together, whose scale nothing but the latter ties down."""
KNOWN = 0.05
"""The same of a light that was given."""
PIXELS = 1024
"""Training pixels that say how well the run explains its images, and what light a typical point receives."""
POINTS_AT_ONCE, SIGHTED_AT_ONCE = 512, 2**16
NEIGHBOURS, NEAR, TURN = 9, 0.1, 0.1
"""Most points that tell how sure one is, itself among them; how near they are, in scene units; and how far a radian between
normals puts two of them apart."""
LEAST_NOISE = 1e-3
"""No image is better than this."""
STEP = 1e-3
"""Of a pixel, for the slope of radiance over it."""
TINY = 1e-9


@dataclass(frozen=True)
class Evidence:
    """What a run's images tell of any of its points.

    Attributes:
        views: the training views.
        noise: half of the relative errors of pixels are below it; errors are relative to the pixel and a share of a
            typical one (`config.light.fit.floor`).
        typical: the mean over points of the shares of diffuse light that come from each patch.
    """

    views: TrainingViews
    noise: float
    typical: Float[Tensor, "3 K"]


@torch.no_grad()
def gather_evidence(run: Run) -> Evidence:
    """Load a run's training views, and compare some of their pixels with what the run shows of them.

    Where it shows no surface in any of them, the noise is as large as the pixels.

    Raises:
        UserError: there are no training views, or one cannot be read.
    """
    model = run.model
    views = TrainingViews(run.capture, next(model.parameters()).device)
    errors, shares = [], []
    pixels = views.evenly(PIXELS)
    for start in range(0, len(pixels), POINTS_AT_ONCE):
        part = pixels[start : start + POINTS_AT_ONCE]
        hits = model.host.render(part.rays)
        rows = torch.nonzero(hits.is_hit(run.config.shading.hit_share))[:, 0]
        if not len(rows):
            continue
        position, wo, seen = hits.position[rows], -part.directions[rows], part.color[rows]
        normal = model.shading_normals(position, hits.normal[rows])
        material = model.materials(position)
        shading = model.shade(position, normal, wo, material, run.config.shading.eval_samples)
        shown = apply_response(shading.color, model.facts.response)
        errors.append(((shown - seen).abs() / _brightness(model, seen)).flatten())
        arriving = arriving_light(model, position, normal, wo[:, None], material)
        parts = by_patch(arriving.light, arriving.patch, patch_count(model))
        shares.append(parts / parts.sum(-1, keepdim=True).clamp_min(TINY))
    if not errors:
        return Evidence(views, 1.0, views.centres.new_zeros(3, patch_count(model)))
    return Evidence(views, max(torch.cat(errors).median().item(), LEAST_NOISE), torch.cat(shares).mean(0))


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
        Root mean square errors, of each point the median of its neighbours' among these: base colour up to a factor per
        channel that is one for all points. Points that no view sees have those of a guess. Roughness and metallic mean
        nothing where the run's shading is Lambertian.
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


def with_deviation(run: Run, evidence: Evidence, view: RenderedView, step: int = 1) -> RenderedView:
    """A rendered view with the maps base_color_std, roughness_std and metallic_std, 0 where it shows no surface.

    With a `step` of k only every k-th pixel of every k-th row is asked, and the k × k about it take after it. A Lambertian
    run has the first map alone.
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
        torch.from_numpy(view.maps[name].reshape(-1, size)[pixels]) for name, size in (("depth", 1), ("normal", 3))
    )
    return OrientedPoints(rays.origins + depth * rays.directions, normal).to(next(run.model.parameters()).device)


def _evened(deviation: Deviation, position: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"]) -> Deviation:
    """Medians over neighbours. Directions are drawn for each point by itself, and what the views of one point do not tell those
    of its neighbours may: the material is a field."""
    place = torch.cat((position, TURN * normal), -1).cpu().numpy()
    nearest = cKDTree(place).query(place, k=range(1, 1 + NEIGHBOURS), distance_upper_bound=NEAR)[1]
    # Where there are fewer, the tree says a row past the last.
    values = (functional.pad(getattr(deviation, f.name), (0, 0, 0, 1), value=math.nan)[nearest] for f in fields(Deviation))
    return Deviation(*(value.nanmedian(1).values for value in values))


def _deviation(
    model: NeilfModel, evidence: Evidence, position: Float[Tensor, "N 3"], normal: Float[Tensor, "N 3"], seen: Sightings
) -> Deviation:
    """Of points that are treated together."""
    material = model.materials(position)
    specular = model.config.shading.specular
    arriving = arriving_light(model, position, normal, seen.wo, material)
    patches = patch_count(model)
    diffuse = arriving.light.sum(1) / math.pi
    kd, f0 = diffuse_reflectance(material, specular), normal_reflectance(material)
    nodes = diffuse.new_tensor(ROUGHNESS_NODES)[:, None, None].expand(-1, len(diffuse), 1)
    facing = diffuse.new_zeros(len(diffuse), seen.wo.shape[1], len(nodes), 3)
    grazing, sent = torch.zeros_like(facing), []
    for v, wo in enumerate(seen.wo.unbind(1)):
        reflected = kd[:, None] / math.pi
        if specular:
            cos = cosines(normal, wo, arriving.wi)
            i, o, steep = cos.i.clamp_min(0), cos.o.clamp_min(0), (1 - cos.d).pow(5)
            toward = torch.cat((arriving.light * (1 - steep)[..., None], arriving.light * steep[..., None]), -1)
            lobe = [model.lobe.distribution(cos.h, r) * model.lobe.visibility(i, o, r) for r in (*nodes, material.roughness)]
            facing[:, v], grazing[:, v] = (torch.stack(lobe[:-1], 1) @ toward).split(3, -1)
            steep = steep[..., None]
            reflected = reflected + lobe[-1][..., None] * (f0[:, None] * (1 - steep) + steep)
        sent.append(by_patch(arriving.light * reflected, arriving.patch, patches))
    shared = torch.stack(sent, 1)
    deviations = _light_deviations(model).to(shared)
    peculiar = shared - shared.sum(-1, keepdim=True) * evidence.typical
    outside = torch.cat((peculiar[..., :PATCHES], peculiar[..., 2 * PATCHES :]), -1).sum(-1, keepdim=True)
    errors = torch.cat((peculiar * deviations[:-1], outside * deviations[-1]), -1)
    radiance, brighter = (_to_radiance(model, seen.pixel + step) for step in (0.0, STEP))
    noise = evidence.noise * _brightness(model, seen.pixel) * (brighter - radiance) / STEP
    sights = Sights(seen.seen, radiance, noise, errors)
    return expected_error(Looks(diffuse, facing, grazing), sights, material, specular)


def _light_deviations(model: NeilfModel) -> Float[Tensor, " E"]:
    """Of each patch, and last of all light from outside together."""
    known = model.config.light.map is not None
    direct, overall = (KNOWN, KNOWN) if known else (DIRECT, OVERALL)
    lamps = patch_count(model) - 2 * PATCHES
    return torch.tensor([direct] * PATCHES + [REFLECTED] * PATCHES + [DIRECT] * lamps + [overall])


def _brightness(model: NeilfModel, pixel: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
    """What errors of pixels are relative to, in the response of the capture."""
    typical = apply_response(torch.tensor(model.facts.median_radiance), model.facts.response).item()
    return pixel + model.config.light.fit.floor * typical


def _to_radiance(model: NeilfModel, pixel: Float[Tensor, "*B 3"]) -> Float[Tensor, "*B 3"]:
    return pixel if model.facts.response == "linear" else srgb_to_linear(pixel)
