"""Maps of rendered views beside the truth, as 8-bit images for reports and contact sheets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8

from neilfpp_method.evaluate.contact_sheet import Group, PictureRow, Section
from neilfpp_method.evaluate.metrics import align_scale
from neilfpp_method.evaluate.pictures import auto_exposure, cut_out, display, display_color, display_error
from neilfpp_method.evaluate.views import KnownView, RenderedView
from neilfpp_method.shading.color import srgb_to_linear
from neilfpp_method.train.run import Run

__all__ = ["ComparedMap", "MapComparison", "albedo_scale", "compared_maps", "view_sections"]

LARGEST_IMAGE_ERROR = 0.25
"""Error at the bright end of the colour scale for images, in display values."""
LARGEST_MATERIAL_ERROR = 0.5
"""Error at the bright end of the colour scale for material maps, and for their expected errors."""
LARGEST_ANGLE = 45.0
"""Error at the bright end of the colour scale for normals, degrees."""


@dataclass(frozen=True)
class MapComparison:
    """One map of one view as 8-bit images.

    Attributes:
        estimate: the map as rendered.
        truth: the true map, or None.
        error: the difference as colours, or None without truth.
        hit: pixels at which the estimate has a surface; None if the whole frame counts.
        known: pixels at which the truth has a surface; None if the whole frame counts or there is no truth.
    """

    estimate: UInt8[np.ndarray, "H W 3"]
    truth: UInt8[np.ndarray, "H W 3"] | None = None
    error: UInt8[np.ndarray, "H W 3"] | None = None
    hit: Bool[np.ndarray, "H W"] | None = None
    known: Bool[np.ndarray, "H W"] | None = None


@dataclass(frozen=True)
class ComparedMap:
    """One map of several views.

    Attributes:
        name: name of the map in `structures.Maps`.
        title: title for display.
        note: a remark for display, such as the exposure.
        comparisons: one entry per view.
        largest: error at the bright end of the colour scale.
        unit: unit of the error.
    """

    name: str
    title: str
    note: str
    comparisons: tuple[MapComparison, ...]
    largest: float
    unit: str = ""

    @property
    def has_truth(self) -> bool:
        """Whether the truth is known for at least one view."""
        return any(c.truth is not None for c in self.comparisons)

    @property
    def row(self) -> PictureRow:
        """A row with truth, estimate and error of each view."""
        cells = tuple(cell for c in self.comparisons for cell in (c.truth, c.estimate, c.error))
        return PictureRow(self.title, cells, self.note, f"{self.largest:g}{self.unit}")

    @property
    def estimates(self) -> PictureRow:
        """A row with the estimate of each view."""
        return PictureRow(self.title, tuple(c.estimate for c in self.comparisons), self.note)


def view_sections(
    run: Run,
    rendered: Sequence[RenderedView],
    known: Sequence[KnownView],
    scale: Float[np.ndarray, " 3"] | None,
) -> list[Section]:
    """Sections of a contact sheet: maps with known truth in three columns per view, the others in one.

    `scale` is that of `albedo_scale`. Volume-rendered images are shown only while there is no material.
    """
    maps = compared_maps(run, rendered, known, scale)
    if run.has_material:
        maps = [m for m in maps if m.name != "rgb_volume"]
    with_truth = tuple(m.row for m in maps if m.has_truth)
    without_truth = tuple(m.estimates for m in maps if not m.has_truth)
    titles = [f"View {view.name}" for view in rendered]
    sections = [Section(tuple(Group(title, ("truth", "estimate", "error")) for title in titles), with_truth)]
    if without_truth:
        sections.append(Section(tuple(Group(title, ("estimate",)) for title in titles), without_truth))
    return sections


def compared_maps(
    run: Run,
    rendered: Sequence[RenderedView],
    known: Sequence[KnownView],
    scale: Float[np.ndarray, " 3"] | None,
) -> list[ComparedMap]:
    """All maps of rendered views beside the truth: images, material, its expected errors, and normals.

    Args:
        run: the run.
        rendered: the rendered views. Expected errors are included if the views have these maps.
        known: the same views as captured.
        scale: factor per channel for an additional map of scaled base colour; None leaves this map out.
    """
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
    masked = np.concatenate([image[k.mask] for image, k in zip(images, known, strict=True)])
    exposure = auto_exposure(masked) if run.capture.hdr else 1.0
    comparisons = []
    for view, image in zip(rendered, images, strict=True):
        estimate, truth = display_color(view.maps[name], exposure), display_color(image, exposure)
        error = display_error(_difference(estimate, truth), LARGEST_IMAGE_ERROR)
        comparisons.append(MapComparison(estimate, truth, error))
    source = "rendering equation" if name == "rgb" else "volume rendering"
    note = f"{source}\nexposure {exposure:.2g}" if run.capture.hdr else source
    return ComparedMap(name, "Image", note, tuple(comparisons), LARGEST_IMAGE_ERROR)


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
        estimate = display(name, view.maps[name] * factor)
        hit = view.maps["base_color"].any(-1)
        comparison = MapComparison(cut_out(estimate, hit), hit=hit)
        if k.material is not None:
            truth = display(name, k.material[name])
            error = display_error(_difference(estimate, truth), LARGEST_MATERIAL_ERROR)
            comparison = replace(
                comparison, truth=cut_out(truth, k.mask), error=cut_out(error, k.mask), known=k.mask
            )
        comparisons.append(comparison)
    return ComparedMap(name, title, note, tuple(comparisons), LARGEST_MATERIAL_ERROR)


def _deviation_maps(rendered: Sequence[RenderedView]) -> Iterator[ComparedMap]:
    """Expected errors of the material, if the views have these maps."""
    for title, name in (
        ("Base colour", "base_color_std"),
        ("Roughness", "roughness_std"),
        ("Metallic", "metallic_std"),
    ):
        if all(name in view.maps for view in rendered):
            note = f"expected error\ndark 0, bright {LARGEST_MATERIAL_ERROR:g}"
            comparisons = tuple(_deviation(view, name) for view in rendered)
            yield ComparedMap(name, f"{title} ±", note, comparisons, LARGEST_MATERIAL_ERROR)


def _deviation(view: RenderedView, name: str) -> MapComparison:
    picture = display_error(view.maps[name][..., 0], LARGEST_MATERIAL_ERROR)
    hit = view.surface_mask
    return MapComparison(cut_out(picture, hit), hit=hit)


def _normal_map(rendered: Sequence[RenderedView], known: Sequence[KnownView]) -> ComparedMap:
    comparisons = []
    for view, k in zip(rendered, known, strict=True):
        normal = view.maps["normal"]
        hit = view.surface_mask
        comparison = MapComparison(cut_out(display("normal", normal), hit), hit=hit)
        if k.normal is not None:
            angle = np.degrees(np.arccos(np.clip((normal * k.normal).sum(-1), -1.0, 1.0)))
            error = cut_out(display_error(angle, LARGEST_ANGLE), k.mask)
            truth = cut_out(display("normal", k.normal), k.mask)
            comparison = replace(comparison, truth=truth, error=error, known=k.mask)
        comparisons.append(comparison)
    return ComparedMap("normal", "Normal", "scene axes as colours", tuple(comparisons), LARGEST_ANGLE, "°")


def _difference(a: UInt8[np.ndarray, "H W C"], b: UInt8[np.ndarray, "H W C"]) -> Float[np.ndarray, "H W"]:
    return np.abs(a.astype(np.float32) - b).mean(-1) / 255.0


def albedo_scale(
    rendered: Sequence[RenderedView], known: Sequence[KnownView]
) -> Float[np.ndarray, " 3"] | None:
    """Factor per channel that fits the base colour of the views to the truth; None if no truth is known."""
    pairs = [(view, k) for view, k in zip(rendered, known, strict=True) if k.material is not None]
    if not pairs:
        return None
    estimate = np.concatenate([view.maps["base_color"][k.mask] for view, k in pairs])
    return align_scale(estimate, np.concatenate([k.material["base_color"][k.mask] for _, k in pairs]))
