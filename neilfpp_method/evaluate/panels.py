"""What the report shows: views of a run beside the truth, and incident light at surface points."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from neilfpp_method.data.truth import Truth
from neilfpp_method.data.views import camera_rays
from neilfpp_method.evaluate.metrics import align_scale
from neilfpp_method.evaluate.pictures import (
    Group,
    Row,
    Section,
    auto_exposure,
    cut_out,
    display,
    display_color,
    display_error,
    lat_long_directions,
    nearest_radiance,
    ring,
)
from neilfpp_method.evaluate.views import KnownView, RenderedView
from neilfpp_method.export.probes import spread
from neilfpp_method.shading.color import srgb_to_linear
from neilfpp_method.structures import OrientedPoints
from neilfpp_method.train.run import Run

__all__ = ["ComparedMap", "Comparison", "albedo_scale", "compared_maps", "light_sections", "view_sections"]

POINTS = 4
"""Surface points whose light is shown."""
POINTS_PER_SECTION = 2
"""Of these, side by side in a row."""
LIGHT_HEIGHT = 120
"""Of a picture of light, pixels."""
SHADE = (232, 232, 229)
"""Colour of directions below the surface."""


# ------------------------------------------------------------------------------------------------------ views


@dataclass(frozen=True)
class Comparison:
    """One map of a view for display, and where estimate and truth have a surface, if not all counts."""

    estimate: UInt8[np.ndarray, "H W 3"]
    truth: UInt8[np.ndarray, "H W 3"] | None = None
    error: UInt8[np.ndarray, "H W 3"] | None = None
    hit: Bool[np.ndarray, "H W"] | None = None
    known: Bool[np.ndarray, "H W"] | None = None


@dataclass(frozen=True)
class ComparedMap:
    """One map over all shown views, by its name in `structures.Maps`.

    `largest` is the error at the bright end of its scale, `unit` that of the error.
    """

    name: str
    title: str
    note: str
    comparisons: tuple[Comparison, ...]
    largest: float
    unit: str = ""

    @property
    def has_truth(self) -> bool:
        return any(c.truth is not None for c in self.comparisons)

    @property
    def row(self) -> Row:
        cells = tuple(cell for c in self.comparisons for cell in (c.truth, c.estimate, c.error))
        return Row(self.title, cells, self.note, f"{self.largest:g}{self.unit}")

    @property
    def estimates(self) -> Row:
        return Row(self.title, tuple(c.estimate for c in self.comparisons), self.note)


def view_sections(
    run: Run,
    rendered: Sequence[RenderedView],
    known: Sequence[KnownView],
    scale: Float[np.ndarray, " 3"] | None,
) -> list[Section]:
    """Maps with a truth in three columns a view; those without in one."""
    maps = [
        m
        for m in compared_maps(run, rendered, known, scale)
        if m.name != "rgb_volume" or not run.has_material
    ]
    compared = tuple(m.row for m in maps if m.has_truth)
    alone = tuple(m.estimates for m in maps if not m.has_truth)
    titles = [f"View {view.name}" for view in rendered]
    sections = [Section(tuple(Group(title, ("truth", "estimate", "error")) for title in titles), compared)]
    return sections + (
        [Section(tuple(Group(title, ("estimate",)) for title in titles), alone)] if alone else []
    )


def compared_maps(
    run: Run,
    rendered: Sequence[RenderedView],
    known: Sequence[KnownView],
    scale: Float[np.ndarray, " 3"] | None,
) -> list[ComparedMap]:
    """Every map that the views have: images, the material with its expected errors, normals."""
    images = ("rgb", "rgb_volume") if run.has_material else ("rgb_volume",)
    return [
        *(_image_map(run, name, rendered, known) for name in images),
        *_material_maps(run, rendered, known, scale),
        *_deviation_maps(rendered),
        _normal_map(rendered, known),
    ]


def _image_map(
    run: Run, name: str, rendered: Sequence[RenderedView], known: Sequence[KnownView]
) -> ComparedMap:
    images = [
        k.image if run.capture.hdr else srgb_to_linear(torch.from_numpy(k.image)).numpy() for k in known
    ]
    seen = np.concatenate([image[k.mask] for image, k in zip(images, known, strict=True)])
    exposure = auto_exposure(seen) if run.capture.hdr else 1.0
    comparisons = []
    for view, image in zip(rendered, images, strict=True):
        shown, truth = display_color(view.maps[name], exposure), display_color(image, exposure)
        comparisons.append(Comparison(shown, truth, display_error(_difference(shown, truth), 0.25)))
    source = "rendering equation" if name == "rgb" else "volume rendering"
    note = f"{source}\nexposure {exposure:.2g}" if run.capture.hdr else source
    return ComparedMap(name, "Image", note, tuple(comparisons), 0.25)


def _material_maps(
    run: Run,
    rendered: Sequence[RenderedView],
    known: Sequence[KnownView],
    scale: Float[np.ndarray, " 3"] | None,
) -> Iterator[ComparedMap]:
    if not run.has_material:
        return
    yield _material_map("Base colour", "as estimated", "base_color", rendered, known)
    if scale is not None:
        factors = ", ".join(f"{factor:.2f}" for factor in scale)
        yield _material_map(
            "Base colour", f"scaled per channel\nby {factors}", "base_color", rendered, known, scale
        )
    if run.config.shading.specular:
        yield _material_map("Roughness", "0 black, 1 white", "roughness", rendered, known)
        yield _material_map("Metallic", "0 black, 1 white", "metallic", rendered, known)


def _material_map(
    title: str,
    note: str,
    name: str,
    rendered: Sequence[RenderedView],
    known: Sequence[KnownView],
    factor: float | Float[np.ndarray, " 3"] = 1.0,
) -> ComparedMap:
    comparisons = []
    for view, k in zip(rendered, known, strict=True):
        shown = display(name, view.maps[name] * factor)
        hit = view.maps["base_color"].any(-1)
        comparison = Comparison(cut_out(shown, hit), hit=hit)
        if k.material is not None:
            truth = display(name, k.material[name])
            error = cut_out(display_error(_difference(shown, truth), 0.5), k.mask)
            comparison = replace(comparison, truth=cut_out(truth, k.mask), error=error, known=k.mask)
        comparisons.append(comparison)
    return ComparedMap(name, title, note, tuple(comparisons), 0.5)


def _deviation_maps(rendered: Sequence[RenderedView]) -> Iterator[ComparedMap]:
    """How far off the material may be, on the scale of its errors, of views that have been asked."""
    for title, name in (
        ("Base colour", "base_color_std"),
        ("Roughness", "roughness_std"),
        ("Metallic", "metallic_std"),
    ):
        if all(name in view.maps for view in rendered):
            shown = tuple(
                Comparison(cut_out(display_error(view.maps[name][..., 0], 0.5), _hit(view)), hit=_hit(view))
                for view in rendered
            )
            yield ComparedMap(name, f"{title} ±", "expected error\ndark 0, bright 0.5", shown, 0.5)


def _normal_map(rendered: Sequence[RenderedView], known: Sequence[KnownView]) -> ComparedMap:
    comparisons = []
    for view, k in zip(rendered, known, strict=True):
        normal = view.maps["normal"]
        comparison = Comparison(cut_out(display("normal", normal), _hit(view)), hit=_hit(view))
        if k.normal is not None:
            angle = np.degrees(np.arccos(np.clip((normal * k.normal).sum(-1), -1.0, 1.0)))
            error = cut_out(display_error(angle, 45.0), k.mask)
            truth = cut_out(display("normal", k.normal), k.mask)
            comparison = replace(comparison, truth=truth, error=error, known=k.mask)
        comparisons.append(comparison)
    return ComparedMap("normal", "Normal", "scene axes as colours", tuple(comparisons), 45.0, "°")


def _hit(view: RenderedView) -> Bool[np.ndarray, "H W"]:
    return view.maps["opacity"][..., 0] > 0.5


def _difference(a: UInt8[np.ndarray, "H W C"], b: UInt8[np.ndarray, "H W C"]) -> Float[np.ndarray, "H W"]:
    return np.abs(a.astype(np.float32) - b).mean(-1) / 255.0


def albedo_scale(
    rendered: Sequence[RenderedView], known: Sequence[KnownView]
) -> Float[np.ndarray, " 3"] | None:
    """The factor per channel that fits the base colour of all shown views to the truth; none without it."""
    pairs = [(view, k) for view, k in zip(rendered, known, strict=True) if k.material is not None]
    if not pairs:
        return None
    estimate = np.concatenate([view.maps["base_color"][k.mask] for view, k in pairs])
    return align_scale(estimate, np.concatenate([k.material["base_color"][k.mask] for _, k in pairs]))


# ------------------------------------------------------------------------------------------------------ light


@dataclass(frozen=True)
class LightPoint:
    """A surface point, and the light known to arrive there along the pixels of an unrolled picture."""

    position: Float[np.ndarray, " 3"]
    normal: Float[np.ndarray, " 3"]
    truth: Float[np.ndarray, "H W 3"] | None


def light_sections(
    run: Run, rendered: Sequence[RenderedView], scale: Float[np.ndarray, " 3"] | None
) -> list[Section]:
    """Incident light: the truth, the estimate, and the estimate over the base colour's scale factor.

    What is scaled out of the one is scaled into the other: their product is what the images see. The points
    are from the capture's light field where it has one, else from the first view; no section where that shows
    no surface. Rings in the estimate are about the middles of the lamps that the run has found, those behind
    something else too.
    """
    directions = lat_long_directions(LIGHT_HEIGHT)
    points = _known_points(run, directions) or _seen_points(run, rendered[0])
    if not points:
        return []
    columns: list[list[np.ndarray]] = [_incident_light(run, points, directions)]
    titles = ["estimate"]
    if scale is not None:
        columns.append([light / np.maximum(scale, 1e-6) for light in columns[0]])
        titles.append("estimate, scaled")
    if points[0].truth is not None:
        columns.insert(0, [point.truth for point in points])
        titles.insert(0, "truth")
    above = [directions @ point.normal > 0 for point in points]
    exposure = auto_exposure(np.concatenate([light[a] for light, a in zip(columns[0], above, strict=True)]))
    note = f"+z at the top\nexposure {exposure:.2g}"
    sections = []
    for first in range(0, len(points), POINTS_PER_SECTION):
        groups, pictures = [], []
        for i, point in list(enumerate(points))[first : first + POINTS_PER_SECTION]:
            groups.append(
                Group(
                    "Light at ({:.2f}, {:.2f}, {:.2f})".format(*(point.position.round(2) + 0.0)),
                    tuple(titles),
                )
            )
            for title, column in zip(titles, columns, strict=True):
                picture = cut_out(display_color(column[i], exposure), above[i], SHADE)
                pictures.append(picture if title == "truth" else ring(picture, _lamps_above(run, point)))
        sections.append(Section(tuple(groups), (Row("Incident light", tuple(pictures), note),)))
    return sections


def _lamps_above(run: Run, point: LightPoint) -> Float[np.ndarray, "K 3"]:
    """Directions from a point to the lamps on its surface's side."""
    lamps = run.model.lamps
    if not lamps.lit:
        return np.zeros((0, 3), np.float32)
    towards = lamps.position[: lamps.lit].cpu().numpy() - point.position
    towards = towards[towards @ point.normal > 0]
    return towards / np.maximum(np.linalg.norm(towards, axis=-1, keepdims=True), 1e-9)


def _known_points(run: Run, directions: Float[np.ndarray, "H W 3"]) -> list[LightPoint]:
    """Points of the capture's light field that are unlike one another; none where there is no light field."""
    field = Truth(run.capture).light_field()
    if field is None:
        return []
    rows = spread(OrientedPoints(field.position, field.normal), POINTS).tolist()
    position, normal, wi, incident = (
        t.numpy() for t in (field.position, field.normal, field.wi, field.incident)
    )
    return [
        LightPoint(position[i], normal[i], nearest_radiance(wi[i], incident[i], directions)) for i in rows
    ]


def _seen_points(run: Run, rendered: RenderedView) -> list[LightPoint]:
    """Surface points of a rendered view, spread from its top to its foot; none without a surface."""
    view = next(view for view in run.capture.views if view.name == rendered.name)
    rays = camera_rays(run.capture.normalisation.camera(view.camera))
    hits = np.flatnonzero(_hit(rendered))
    rows = hits[np.linspace(0, len(hits) - 1, POINTS + 2).round().astype(int)[1:-1]] if len(hits) else hits
    depth, normal = rendered.maps["depth"].reshape(-1, 1)[rows], rendered.maps["normal"].reshape(-1, 3)[rows]
    position = rays.origins.numpy()[rows] + depth * rays.directions.numpy()[rows]
    return [LightPoint(x, n, None) for x, n in zip(position, normal, strict=True)]


@torch.no_grad()
def _incident_light(
    run: Run, points: Sequence[LightPoint], directions: Float[np.ndarray, "H W 3"]
) -> list[Float[np.ndarray, "H W 3"]]:
    device = next(run.model.parameters()).device
    wi = torch.from_numpy(directions).reshape(1, -1, 3).to(device)
    positions = [torch.as_tensor(point.position, device=device)[None] for point in points]
    return [run.model.incident_light(x, wi).reshape(directions.shape).cpu().numpy() for x in positions]
