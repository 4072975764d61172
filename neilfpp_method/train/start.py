"""The initial shape of the distance field: the sphere of its initialisation, or a hull.

Training finds a surface faster, and more often the correct one, if it starts from a shape that has the
object's outline in every view: the visual hull of the masks. Concavities are easily carved out of it, whereas
thin parts do not easily grow out of a sphere. Without masks the hull of the point cloud serves. It leaves the
sky empty, which a sphere fills in front of the cameras.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.hulls.cloud_hull import find_cloud_hull
from neilfpp_method.data.hulls.silhouettes import Outline, read_outlines
from neilfpp_method.data.hulls.visual_hull import DistanceCube, find_hull
from neilfpp_method.fields.sdf import SdfField
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.model import NeilfModel
from neilfpp_method.settings.types import NeilfConfig

__all__ = ["GeometryStart", "fit_distance", "start_geometry"]

HULL_VIEWS = 64
"""Maximum number of masks or cameras that a hull is computed from, evenly spaced over the views."""
STEPS = 300
"""Optimizer steps of the fit to the hull."""
POINTS = 2048
"""Sample points per step of the fit."""
NEAR_SHARE = 0.5
"""Share of the sample points that are drawn near the surface of the hull."""
NEAR_SURFACE = 0.1
"""Standard deviation of the offset of these points from the surface, per axis, in scene units."""
RATE = 1e-2
"""Learning rate of Adam for hash grids with their networks; it decays to a tenth. MLPs take a tenth of it."""
DAMPING = 1e-3
"""Adam's ε. A fine grid entry that only one sample point reads has a gradient far below this value, so it
hardly moves. With the usual 1e-15 the entry jumps by the full learning rate: normals at the surface then
deviated by 12.5° from those of the hull instead of 6°, and second derivatives were four times as large.
"""
POOL = 65_536
"""Random points in the cube of the hull from which those near the surface are selected."""


@dataclass(frozen=True)
class GeometryStart:
    """The initial shape of the distance field.

    Attributes:
        shape: the hull in a few words; empty if the field starts as a sphere.
        error: mean absolute difference between the fitted field and the hull's distance at the hull's
            surface, in scene units; None if the field starts as a sphere.
        reason: why the field starts as a sphere.
        warning: whether the capture has masks or points that give no usable hull.
    """

    shape: str = ""
    error: float | None = None
    reason: str = ""
    warning: bool = False

    @property
    def text(self) -> str:
        """One line for the console."""
        if self.error is None:
            return f"{'warning: ' * self.warning}geometry starts as a sphere: {self.reason}"
        return f"geometry starts as {self.shape}, to {self.error:.3f} scene units"


def start_geometry(model: NeilfModel, capture: Capture, config: NeilfConfig) -> GeometryStart | None:
    """Initialise the distance field of a new model as `config.host.sdf.start` requests.

    Only training views are read. The result depends on nothing but `config.train.seed`, the masks, and the
    points that supervise the geometry; the global random state is left unchanged.

    Returns:
        The initial shape; None if the host has no distance field to initialise (a mesh or a borrowed host).
    """
    if not isinstance(model.host, VolSdfHost):
        return None
    if config.host.sdf.start == "sphere":
        return GeometryStart(reason="as the settings say")
    views, points = capture.train_views, model.host.points
    outlines = [_in_scene(outline, capture) for outline in read_outlines(views, HULL_VIEWS)]
    shape, hull = "", "the capture has no masks, and no points supervise the geometry"
    if outlines:
        shape, hull = f"the visual hull of {len(outlines)} masks", find_hull(outlines)
    if isinstance(hull, str) and points is not None:
        cameras = [capture.scene_camera(view) for view in views[:: -(-len(views) // HULL_VIEWS)]]
        shape = f"the hull of {len(points.position)} points"
        hull = find_cloud_hull(points, cameras, model.host.radius)
    if isinstance(hull, str):
        return GeometryStart(reason=hull, warning=bool(outlines) or points is not None)
    error = fit_distance(model.host.sdf_field, hull, model.host.radius, config.train.seed, _rate(config))
    model.host.starts_from_shape = True
    return GeometryStart(shape, error)


def fit_distance(
    field: SdfField, target: DistanceCube, radius: float, seed: int, rate: float = RATE
) -> float:
    """Fit a distance field to a sampled signed distance within a ball about the origin.

    Adam minimises the L1 error of the distance. Half of the sample points are uniform in the ball, half lie
    near the surface. The features of the field, which R reads, do not enter the loss and are unconstrained.

    Args:
        field: the distance field; it is changed in place, on its own device.
        target: the sampled signed distance.
        radius: radius of the ball, in scene units.
        seed: seed of the sample points.
        rate: initial learning rate of Adam.

    Returns:
        The mean absolute error at the surface of `target`, in scene units.
    """
    device = next(field.parameters()).device
    # A generator of its own keeps the random numbers of training independent of the initial shape.
    points = torch.Generator().manual_seed(seed)
    surface = _surface_points(target, radius, points)
    optimizer = torch.optim.Adam(field.parameters(), lr=rate, eps=DAMPING, fused=True)
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.1 ** (1 / STEPS))
    for _ in range(STEPS):
        near = round(NEAR_SHARE * POINTS)
        rows = torch.randint(len(surface), (near,), generator=points)
        about = surface[rows] + NEAR_SURFACE * torch.randn(near, 3, generator=points)
        x = torch.cat([about, _in_ball(POINTS - near, radius, points)])
        error = (field(x.to(device)) - target.at(x).to(device)).abs().mean()
        optimizer.zero_grad(set_to_none=True)
        error.backward()
        optimizer.step()
        schedule.step()
    optimizer.zero_grad(set_to_none=True)
    with torch.no_grad():
        return float((field(surface.to(device)).cpu() - target.at(surface)).abs().mean())


def _surface_points(target: DistanceCube, radius: float, generator: torch.Generator) -> Float[Tensor, "P 3"]:
    """Random points of the cube that lie in the ball and within two grid cells of the surface."""
    x = target.radius * (2 * torch.rand(POOL, 3, generator=generator) - 1)
    x = x[x.norm(dim=-1) < radius]
    distance = target.at(x).abs()
    two_cells = torch.tensor(4 * target.radius / len(target.distance))
    # If the hull is very small, few points lie that near: then the nearest hundredth of the points is taken.
    return x[distance <= torch.maximum(two_cells, distance.kthvalue(len(x) // 100)[0])]


def _in_ball(count: int, radius: float, generator: torch.Generator) -> Float[Tensor, "N 3"]:
    """Points uniformly distributed in a ball about the origin."""
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    return radius * torch.rand(count, 1, generator=generator) ** (1 / 3) * direction


def _in_scene(outline: Outline, capture: Capture) -> Outline:
    """The same outline with its camera in the scene frame."""
    return replace(outline, view=replace(outline.view, camera=capture.scene_camera(outline.view)))


def _rate(config: NeilfConfig) -> float:
    return RATE if config.encoding.kind == "hash" else RATE / 10
