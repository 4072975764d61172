"""Figures of a run's surface and incident light against the true mesh and the true light field."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float

from neilfpp_method.data.mesh import Mesh
from neilfpp_method.data.truth import LightField
from neilfpp_method.evaluate import metrics
from neilfpp_method.export.extract import extract_mesh
from neilfpp_method.model import EVAL_RAYS
from neilfpp_method.train.run import Run
from neilfpp_method.volume.hits import HIT_RADIUS

__all__ = ["chamfer_metrics", "light_metrics"]

SURFACE_POINTS = 500_000
"""Number of points on each surface for Chamfer distances. Two samplings of the same surface have a mean
distance of ½ √(area / points).
"""
MESH_RESOLUTION = 256
"""Number of cells along an edge of the grid from which the estimated surface is extracted."""
MARGIN = 0.05
"""Margin around the bounding box of the true mesh, as a fraction of its diagonal. Points of the estimate
outside do not count: no image shows that region, and a distance field closes its surface there arbitrarily.
"""
OFFSET = 1e-3
"""Height above the surface, scene units, at which occlusion rays start."""


def chamfer_metrics(run: Run, truth: Mesh) -> dict[str, float]:
    """Chamfer distance between the run's surface and the true mesh, scene units.

    Both are sampled uniformly over their area. The result is empty if the run has no surface near the truth.
    """
    true = trimesh.Trimesh(truth.vertices.numpy(), truth.faces.numpy(), process=False)
    margin = MARGIN * np.linalg.norm(true.extents)
    low, high = true.bounds[0] - margin, true.bounds[1] + margin
    corner = np.linalg.norm(np.maximum(np.abs(low), np.abs(high)))
    device = run.device
    # Stay inside the sphere that may close the scene, which is not part of the object. Parts outside the
    # box are removed below.
    radius = min(float(corner), run.config.background.radius - HIT_RADIUS)
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


def light_metrics(run: Run, field: LightField, mesh: Mesh | None) -> dict[str, float]:
    """Log errors of the incident light at the points and directions of a true light field.

    Images determine light only up to a factor per channel, which the base colour compensates. `_scaled`
    figures remove the median log ratio of each channel over all points and directions.

    Args:
        run: the run, with a material.
        field: the true light field.
        mesh: the true surface, from which occluded directions are computed; or None.
    """
    estimate, true = _incident_light(run, field), field.incident.numpy()
    ratio = metrics.log_ratio(estimate.reshape(-1, 3), true.reshape(-1, 3))
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
    device = run.device
    directions_at_once = EVAL_RAYS * run.config.shading.eval_samples
    points = max(1, directions_at_once // field.wi.shape[1])
    chunks = zip(field.position.split(points), field.wi.split(points), strict=True)
    light = [run.model.incident_light(x.to(device), wi.to(device)).cpu() for x, wi in chunks]
    return torch.cat(light).numpy()


def _occluded(field: LightField, mesh: Mesh) -> Bool[np.ndarray, " P"]:
    """Whether each direction of the light field hits the true surface; points and directions flattened."""
    surface = trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy(), process=False)
    origins = (field.position + OFFSET * field.normal)[:, None].expand_as(field.wi)
    return surface.ray.intersects_any(origins.reshape(-1, 3).numpy(), field.wi.reshape(-1, 3).numpy())
