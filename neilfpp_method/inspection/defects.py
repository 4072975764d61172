"""Find the defects of a capture: figures that exceed limits, with remedies."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from neilfpp_method.data.cameras.camera import POSE_MISTAKES
from neilfpp_method.data.capture import Capture
from neilfpp_method.data.hulls.inverted_masks import look_inverted
from neilfpp_method.data.hulls.silhouettes import Outline
from neilfpp_method.data.point_cloud import load_point_cloud
from neilfpp_method.errors import UserError
from neilfpp_method.inspection.measure import ViewFigures, measure
from neilfpp_method.inspection.radiance import RadianceQuality, radiance_quality
from neilfpp_method.inspection.relations import (
    CameraPlacement,
    camera_placement,
    duplicates,
    exposure_factors,
)

__all__ = [
    "MIN_COUNT",
    "Defect",
    "Inspection",
    "inspect_capture",
    "problems",
    "problems_of_masks",
    "problems_of_poses",
    "views_to_leave_out",
]

Severity = Literal["problem", "warning"]

MIN_BRIGHTNESS_RATIO = 1.5
"""Smallest ratio of the brightness of a view to that of its neighbours, or its inverse, that is reported."""
MAX_BLURRED_RATIO = 0.4
"""Ratio of the sharpness of a view to that of the others, below which it is blurred."""
CLIPPED_VIEW = 0.01
"""Share of clipped pixels above which a view is reported."""
INVALID_VIEW = 0.5
"""Share of invalid pixels above which a view is reported."""
MIN_COUNT, ADVISED_COUNT = 3, 16
"""Fewer views than the first are a problem, fewer than the second a warning."""
MIN_CAMERA_EXTENT = 0.02
"""Extent of the camera centres below which all cameras are at one place, as a share of their median distance
from the centre or, if they are within the unit sphere, in scene units. The object then moves by about 20
pixels between views of 1000 pixels.
"""
SPARSE_GAP = 25.0
"""Median angle to the nearest view, degrees, above which views are sparse."""
MIN_COVERAGE = 0.25
"""Smallest share of the directions around the object that the views should cover."""
EDGE, STRAY_POINTS, SMALL_CLOUD = 1.05, 0.1, 0.2
"""Distance from the centre beyond which a point is outside the box, in scene units; share of such points that
is reported; extent below which the object is small for its box, in scene units."""
DISPLAY_LEVELS = 256
"""Number of levels of 8-bit images. Linear images with so few levels were converted from 8-bit images."""
PIXELS_PER_LEVEL = 16
"""Smallest number of pixels per level with which the number of levels is meaningful."""
REMOVABLE: Mapping[str, str] = {
    "black": "black",
    "blurred": "blurred",
    "duplicate": "the same picture as another",
}
"""Kinds of defects whose views `--auto` leaves out, with the reason in a few words."""
MAX_NAMED = 6
"""Largest number of views that a defect names; the others are counted."""


@dataclass(frozen=True)
class Defect:
    """A defect of a capture, and its remedy.

    A problem spoils or prevents a result, a warning degrades it. `views` has the names of the affected views;
    it is empty if the whole capture is affected. `kind` is a short name that does not change between
    versions.
    """

    kind: str
    severity: Severity
    text: str
    remedy: str
    views: tuple[str, ...] = ()

    def line(self) -> str:
        """The defect in one line for the console, without its severity."""
        rest = f" and {len(self.views) - MAX_NAMED} more" if len(self.views) > MAX_NAMED else ""
        named = f" [{', '.join(self.views[:MAX_NAMED])}{rest}]" if self.views else ""
        return f"{self.text}{named}; {self.remedy}"


@dataclass(frozen=True)
class Inspection:
    """The result of an inspection.

    Attributes:
        capture: the capture.
        views: figures of each view, in the order of the capture.
        placement: the placement of the cameras, in the same order.
        factors: brightness of each view relative to its neighbours (`exposure_factors`), in the same order.
        defects: the defects, problems first.
        radiance: the quality of the radiance.
    """

    capture: Capture
    views: tuple[ViewFigures, ...]
    placement: CameraPlacement
    factors: tuple[float, ...]
    defects: tuple[Defect, ...]
    radiance: RadianceQuality


def inspect_capture(capture: Capture, on_view: Callable[[str], None] = lambda name: None) -> Inspection:
    """Inspect a capture; this reads every image.

    Args:
        capture: the capture.
        on_view: called with the name of each view after it has been measured.
    """
    views = []
    for view in capture.views:
        views.append(measure(view, capture.hdr))
        on_view(view.name)
    placement = camera_placement(capture)
    factors = tuple(exposure_factors([view.luminance for view in views], placement).tolist())
    outlines = [view.outline for view in views if view.outline is not None]
    defects = (
        *_mask_defects(outlines),
        *_view_defects(views, factors, capture),
        *_camera_defects(capture, placement),
        *_scene_defects(capture),
    )
    radiance = radiance_quality(views, capture.hdr, {defect.kind for defect in defects})
    order = {"problem": 0, "warning": 1}
    ranked = tuple(sorted(defects, key=lambda defect: order[defect.severity]))
    return Inspection(capture, tuple(views), placement, factors, ranked, radiance)


def problems(inspection: Inspection) -> tuple[str, ...]:
    """Return one line for the console per defect that is a problem."""
    return _lines_of_problems(inspection.defects)


def problems_of_poses(capture: Capture) -> tuple[str, ...]:
    """The same as `problems`, for cameras and point cloud only; fast, because no image is read."""
    found = (*_camera_defects(capture, camera_placement(capture)), *_scene_defects(capture))
    return _lines_of_problems(found)


def problems_of_masks(outlines: Sequence[Outline]) -> tuple[str, ...]:
    """The same as `problems`, for masks that have been read already."""
    return _lines_of_problems(tuple(_mask_defects(outlines)))


def _lines_of_problems(defects: Sequence[Defect]) -> tuple[str, ...]:
    return tuple(f"problem: {defect.line()}" for defect in defects if defect.severity == "problem")


def views_to_leave_out(inspection: Inspection) -> Mapping[str, str]:
    """Return the views that a better capture would not have: black ones, blurred ones, and duplicates.

    Returns:
        The reason by the name of the view. With fewer than `MIN_COUNT` other views, none can be left out.

    Example:
        >>> views_to_leave_out(inspect_capture(load_capture("captures/teapot")))
        {'IMG_0017': 'blurred'}
    """
    return {
        name: REMOVABLE[defect.kind]
        for defect in inspection.defects
        if defect.kind in REMOVABLE
        for name in defect.views
    }


def _view_defects(
    views: Sequence[ViewFigures], factors: Sequence[float], capture: Capture
) -> Iterator[Defect]:
    yield from _file_defects(views)
    yield from _exposure_defects(views, factors, capture)
    readable = [view for view in views if not view.unreadable]
    yield from _image_defects(readable)
    yield from _value_defects(readable, capture)


def _mask_defects(outlines: Sequence[Outline]) -> Iterator[Defect]:
    """Masks of the surroundings instead of the object."""
    if outlines and look_inverted(outlines):
        text = "the masks look inverted: they are black on the object and white around it"
        remedy = "invert the masks, or the alpha channel: the object is white"
        yield Defect("inverted_masks", "problem", text, remedy)


def _file_defects(views: Sequence[ViewFigures]) -> Iterator[Defect]:
    """Files that hold no usable image."""
    if damaged := [view for view in views if view.unreadable]:
        text, remedy = damaged[0].unreadable, "export these images again, or leave them out"
        yield Defect("unreadable", "problem", text, remedy, _names(damaged))
    if broken := [view for view in views if view.broken > 0]:
        largest = max(view.broken for view in broken)
        text = f"pixels are NaN, infinite or negative, up to {100 * largest:.2g} % of a view"
        remedy = "repair them, or mark them in a validity mask"
        yield Defect("broken_pixels", "problem", text, remedy, _names(broken))
    if black := [view for view in views if not view.unreadable and view.luminance <= 0]:
        text = "all pixels of the object are black, or the whole picture has one colour"
        remedy = "leave these views out, or correct the masks"
        yield Defect("black", "problem", text, remedy, _names(black))


def _exposure_defects(
    views: Sequence[ViewFigures], factors: Sequence[float], capture: Capture
) -> Iterator[Defect]:
    """Views that are brighter or darker than the views around them."""
    pairs = zip(views, factors, strict=True)
    jumps = {view.name: factor for view, factor in pairs if max(factor, 1 / factor) > MIN_BRIGHTNESS_RATIO}
    if jumps:
        named = _listed([f"{name} ×{factor:.2g}" for name, factor in jumps.items()], max_parts=4)
        text = f"brighter or darker than the views around them: {named}"
        own = "give these views their exposure in capture.json"
        alike = "expose all images alike, or merge brackets"
        yield Defect("exposure_jump", "problem", text, own if capture.hdr else alike, tuple(jumps))


def _image_defects(views: Sequence[ViewFigures]) -> Iterator[Defect]:
    """Pictures that add nothing: blurred ones and duplicates."""
    sharp = np.median([view.sharpness for view in views if view.sharpness > 0] or [0.0])
    if blurred := [view for view in views if 0 < view.sharpness < MAX_BLURRED_RATIO * sharp]:
        text = f"blurred: less than {100 * MAX_BLURRED_RATIO:.0f} % of the usual fine detail"
        remedy = "leave these views out, or take them again"
        yield Defect("blurred", "warning", text, remedy, _names(blurred))
    if pairs := duplicates([view.small for view in views]) if views else ():
        named = _listed([f"{views[i].name} and {views[j].name}" for i, j in pairs], max_parts=3)
        again = tuple(dict.fromkeys(views[j].name for _, j in pairs))
        yield Defect("duplicate", "warning", f"the same picture twice: {named}", "keep one of each", again)


def _value_defects(views: Sequence[ViewFigures], capture: Capture) -> Iterator[Defect]:
    """Pixel values that carry too little information."""
    if clipped := [view for view in views if view.clipped > CLIPPED_VIEW]:
        worst = max(clipped, key=lambda view: view.clipped)
        text = f"highlights are clipped, up to {100 * worst.clipped:.2g} % of the object ({worst.name})"
        remedy = "use shorter exposures, or merge brackets; mark clipped pixels in a validity mask"
        yield Defect("clipped", "warning", text, remedy, _names(clipped))
    if invalid := [view for view in views if view.invalid > INVALID_VIEW]:
        text = "more than half of the pixels are marked as invalid"
        remedy = "check the validity masks: white is valid"
        yield Defect("mostly_invalid", "warning", text, remedy, _names(invalid))
    large = [view.levels for view in views if view.pixels > PIXELS_PER_LEVEL * DISPLAY_LEVELS]
    if capture.hdr and large and max(large) <= DISPLAY_LEVELS:
        text = f"linear files with {max(large)} levels per channel: they were converted from 8-bit images"
        yield Defect("few_levels", "problem", text, "develop the RAW files linearly, or merge brackets")


def _names(views: Sequence[ViewFigures]) -> tuple[str, ...]:
    return tuple(view.name for view in views)


def _listed(parts: Sequence[str], max_parts: int) -> str:
    """The first parts, separated by commas, with an ellipsis if there are more."""
    return ", ".join(parts[:max_parts]) + ("…" if len(parts) > max_parts else "")


def _camera_defects(capture: Capture, placement: CameraPlacement) -> Iterator[Defect]:
    """Cameras that see the wrong thing, are too few, or are too close to or too far from each other."""
    names = np.array([view.name for view in capture.views])
    if placement.away.any():
        text = "the cameras look away: the centre of the scene is not in the picture"
        remedy = "check the poses and the scene box"
        remedy += f": {POSE_MISTAKES}" if placement.away.mean() > 0.5 else ", or leave these views out"
        yield Defect("looking_away", "problem", text, remedy, tuple(names[placement.away]))
    if placement.within.any():
        text = "these cameras are inside the unit sphere, which should contain only the object"
        yield Defect(
            "camera_inside", "warning", text, "make the scene box smaller", tuple(names[placement.within])
        )
    count = len(names)
    if count < ADVISED_COUNT:
        severity: Severity = "problem" if count < MIN_COUNT else "warning"
        remedy = f"take {ADVISED_COUNT} or more, better 50, from all around"
        yield Defect("few_views", severity, f"{count} view{'s' * (count != 1)}", remedy)
    distance = max(1.0, float(np.median(np.linalg.norm(placement.centers, axis=1))))
    if count > 1 and np.ptp(placement.centers, axis=0).max() < MIN_CAMERA_EXTENT * distance:
        text = "all cameras are at one place, so the images hardly determine the geometry"
        yield Defect("one_place", "problem", text, "take photographs from several sides")
    if count >= MIN_COUNT and placement.coverage < MIN_COVERAGE:
        text = f"the views cover {100 * placement.coverage:.0f} % of the directions around the object"
        yield Defect("coverage", "warning", text, "add views from other sides, and from other heights")
    if count >= MIN_COUNT and placement.gap > SPARSE_GAP:
        text = f"{placement.gap:.0f}° is the median angle from a view to its nearest neighbour"
        yield Defect("sparse", "warning", text, f"add views between them, at most {SPARSE_GAP:.0f}° apart")


def _scene_defects(capture: Capture) -> Iterator[Defect]:
    """A scene box without a reliable source, and a point cloud that is damaged or does not fit the box."""
    if capture.scene_from == "cameras":
        text = "position and size of the scene are guessed from the cameras only"
        yield Defect("scale_guessed", "warning", text, "add a scene box, a point cloud or masks")
    if capture.point_cloud is None:
        return
    try:
        points = load_point_cloud(capture.point_cloud, capture.normalization).position
    except UserError as error:
        yield Defect("point_cloud", "problem", error.problem, error.remedy)
        return
    reach = points.abs().amax(dim=-1).numpy()
    # A box around the point that the cameras look at excludes background points on purpose.
    outside = 0.0 if capture.scene_from == "focus" else float((reach > EDGE).mean())
    if outside > STRAY_POINTS:
        text = f"{100 * outside:.0f} % of the point cloud lies outside of the scene box"
        remedy = "make the scene box larger, or cut the cloud to the object"
        yield Defect("scale", "problem" if outside > 0.5 else "warning", text, remedy)
    elif np.quantile(reach, 0.95) < SMALL_CLOUD:
        text = f"95 % of the point cloud lies within {100 * SMALL_CLOUD:.0f} % of the scene box"
        yield Defect("scale", "warning", f"the object is small: {text}", "make the scene box smaller")
