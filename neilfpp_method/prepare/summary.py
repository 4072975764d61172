"""What preparing came to: figures for each image and for the whole, as JSON and as lines for people."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from neilfpp_method.data.capture import FOUND
from neilfpp_method.data.colmap_library import pycolmap
from neilfpp_method.data.images import replacing
from neilfpp_method.data.views import SceneSource

__all__ = ["Placement", "Summary", "describe_cameras", "placements", "remarks_on", "write_summary"]

MIN_FEATURES = 100
MAX_ERROR = 1.5


@dataclass(frozen=True)
class Placement:
    """An image in the model: how many features it has, how many of them became points, and how far off in
    pixels, in the mean, these are; none where the image is not placed.
    """

    name: str
    features: int
    points: int | None
    error: float | None


@dataclass(frozen=True)
class Summary:
    """The outcome. `placements` is empty and `models` too where poses came with the images. `remarks` are
    what a person should know, `problems` what `neilfpp inspect` says spoils or prevents a result.
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
        """The mean reprojection error of the images that are placed, pixels."""
        errors = [p.error for p in self.placements if p.error is not None]
        return float(np.mean(errors)) if errors else None

    @property
    def lines(self) -> list[str]:
        """For people."""
        lines = []
        if self.placements:
            lines.append(
                f"{self.views} of {len(self.placements)} images placed, reprojection error {self.error:.2f} "
                "pixels"
            )
        else:
            lines.append(f"{self.views} views, with the poses that they came with")
        lines += [
            f"camera {camera['model']}: {camera['images']} images, {_parameters(camera)}"
            for camera in self.cameras
        ]
        lines.append(f"point cloud: {self.points} points with normals ({self.cloud})")
        lines.append(f"radius of the scene: {self.radius:.4g}{FOUND[self.scene_from]}")
        return [*lines, *(f"note: {remark}" for remark in self.remarks), *self.problems]


def placements(features: Mapping[str, int], model: pycolmap.Reconstruction) -> tuple[Placement, ...]:
    """Every image that has been looked at, in the order of the names."""
    found = {}
    for i in model.reg_image_ids():
        image = model.image(i)
        points = [model.point3D(p.point3D_id) for p in image.points2D if p.has_point3D()]
        error = float(np.mean([point.error for point in points])) if points else 0.0
        found[image.name.removesuffix(".png")] = (len(points), error)
    return tuple(
        Placement(name, count, *found.get(name, (None, None))) for name, count in sorted(features.items())
    )


def describe_cameras(model: pycolmap.Reconstruction) -> tuple[dict[str, Any], ...]:
    """The cameras of a model, as estimated, and whether EXIF had told their focal lengths."""
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
    """What a person should know about a model that is good enough."""
    remarks = []
    if missing := [p.name for p in placed if p.points is None]:
        remarks.append(f"not placed, and left out: {', '.join(missing)}")
    if len(models) > 1:
        remarks.append(
            f"the images fell into {len(models)} models of {', '.join(map(str, models))} images; the first "
            "is used"
        )
    if poor := [p.name for p in placed if p.features < MIN_FEATURES]:
        remarks.append(f"fewer than {MIN_FEATURES} features in {', '.join(poor)}")
    if off := [p.name for p in placed if (p.error or 0.0) > MAX_ERROR]:
        remarks.append(f"reprojection error above {MAX_ERROR} pixels in {', '.join(off)}")
    if not all(camera["focal_from_exif"] for camera in cameras):
        remarks.append("EXIF does not tell the focal length; it is estimated from the images")
    return remarks


def _parameters(camera: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {value:.5g}" for name, value in camera["parameters"].items())
