"""The summary of `neilfpp prepare`: figures of each image and of the capture, for the console and as JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neilfpp_method.data.cameras.colmap_library import pycolmap
from neilfpp_method.data.capture import BOX_SOURCES
from neilfpp_method.data.files.atomic_file import replacing
from neilfpp_method.data.views import SceneSource

__all__ = ["Placement", "Summary", "describe_cameras", "placements", "remarks_on", "write_summary"]

MIN_FEATURES = 100
"""Number of features below which an image is named in the remarks; a sharp image has thousands."""

MAX_ERROR = 1.5
"""Mean reprojection error, in pixels, above which an image is named in the remarks; most are below 1."""


@dataclass(frozen=True)
class Placement:
    """How well an image fits the model of structure from motion.

    Attributes:
        name: name of the image.
        features: number of its features.
        points: number of features with a 3D point; None if the image is not placed.
        error: mean reprojection error of these points, in pixels; None if the image is not placed.
    """

    name: str
    features: int
    points: int | None
    error: float | None


@dataclass(frozen=True)
class Summary:
    """The figures of a finished capture.

    Attributes:
        placements: how well each image fits the model; empty if the poses came with the images.
        models: number of images of each model; empty if the poses came with the images.
        cameras: the estimated cameras, as in `describe_cameras`.
        views: number of views.
        points: number of points of the oriented cloud.
        cloud: description of the origin of the cloud.
        radius: radius of the scene's sphere, world units.
        scene_from: origin of the scene's sphere.
        remarks: notes for the user.
        problems: defects found by `neilfpp inspect` that spoil or prevent a result.
    """

    placements: tuple[Placement, ...]
    models: tuple[int, ...]
    cameras: tuple[Mapping[str, Any], ...]
    views: int
    points: int
    cloud: str
    radius: float
    scene_from: SceneSource
    remarks: tuple[str, ...]
    problems: tuple[str, ...] = ()

    @property
    def error(self) -> float | None:
        """Mean reprojection error of the placed images, in pixels; None if there is none."""
        errors = [p.error for p in self.placements if p.error is not None]
        return float(np.mean(errors)) if errors else None

    @property
    def lines(self) -> list[str]:
        """The summary as lines for the console."""
        lines = []
        if self.placements:
            lines.append(
                f"{self.views} of {len(self.placements)} images placed, reprojection error {self.error:.2f} "
                "pixels"
            )
        else:
            lines.append(f"{self.views} views, with the poses of the given capture")
        lines += [
            f"camera {camera['model']}: {camera['images']} images, {_parameters(camera)}"
            for camera in self.cameras
        ]
        lines.append(f"point cloud: {self.points} points with normals ({self.cloud})")
        lines.append(f"radius of the scene: {self.radius:.4g}{BOX_SOURCES[self.scene_from]}")
        return [*lines, *(f"note: {remark}" for remark in self.remarks), *self.problems]


def placements(features: Mapping[str, int], model: pycolmap.Reconstruction) -> tuple[Placement, ...]:
    """Return how well each image fits the model, in the order of the names."""
    placed = {}
    for i in model.reg_image_ids():
        image = model.image(i)
        points = [model.point3D(p.point3D_id) for p in image.points2D if p.has_point3D()]
        error = float(np.mean([point.error for point in points])) if points else 0.0
        placed[image.name.removesuffix(".png")] = (len(points), error)
    return tuple(
        Placement(name, count, *placed.get(name, (None, None))) for name, count in sorted(features.items())
    )


def describe_cameras(model: pycolmap.Reconstruction) -> tuple[dict[str, Any], ...]:
    """Return the estimated cameras of a model, and whether EXIF gave their focal lengths."""
    ids = [model.image(i).camera_id for i in model.reg_image_ids()]
    return tuple(
        {
            "model": camera.model_name,
            "size": [camera.width, camera.height],
            "images": ids.count(number),
            "parameters": dict(zip(camera.params_info.split(", "), map(float, camera.params), strict=True)),
            "focal_from_exif": bool(camera.has_prior_focal_length),
        }
        for number, camera in sorted(model.cameras.items())
    )


def write_summary(path: Path, summary: Summary) -> None:
    """Write the summary as JSON."""
    with replacing(path) as temporary:
        entries = {**asdict(summary), "mean_reprojection_error": summary.error}
        temporary.write_text(json.dumps(entries, indent=1, allow_nan=False) + "\n", "utf-8")


def remarks_on(
    placed: Sequence[Placement], models: Sequence[int], cameras: Sequence[Mapping[str, Any]]
) -> list[str]:
    """Return notes about an accepted model that the user should know."""
    remarks = []
    if missing := [p.name for p in placed if p.points is None]:
        remarks.append(f"left out because they could not be placed: {', '.join(missing)}")
    if len(models) > 1:
        remarks.append(
            f"the images are in {len(models)} separate models of {', '.join(map(str, models))} images; the "
            "first is used"
        )
    if poor := [p.name for p in placed if p.features < MIN_FEATURES]:
        remarks.append(f"fewer than {MIN_FEATURES} features in {', '.join(poor)}")
    if off := [p.name for p in placed if (p.error or 0.0) > MAX_ERROR]:
        remarks.append(f"reprojection error above {MAX_ERROR} pixels in {', '.join(off)}")
    if not all(camera["focal_from_exif"] for camera in cameras):
        remarks.append("the focal length is not in EXIF; it is estimated from the images")
    return remarks


def _parameters(camera: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {value:.5g}" for name, value in camera["parameters"].items())
