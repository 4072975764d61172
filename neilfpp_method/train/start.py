"""What the distance field starts as: the sphere that it is made as, or the visual hull of the masks.

Training finds a surface faster, and more often the right one, from a body that has the object's outline in
every view: hollows are carved from there, while a sphere has to grow legs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.silhouettes import Outline, read_outlines
from neilfpp_method.data.visual_hull import DistanceCube, find_hull
from neilfpp_method.fields.sdf import SdfField
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.model import NeilfModel
from neilfpp_method.settings.types import NeilfConfig

__all__ = ["GeometryStart", "fit_distance", "start_geometry"]

HULL_VIEWS = 64
"""Masks that are asked at most, evenly chosen."""
STEPS = 300
"""Steps of the fit."""
POINTS = 2048
"""Points of a step."""
NEAR_SHARE = 0.5
"""Share of the points that lie about the surface."""
NEAR_SURFACE = 0.1
"""How far from the surface these lie, scene units, standard deviation."""
RATE = 1e-2
"""Adam's rate for the grids and networks of `fast`, falling to a tenth; sine networks take a tenth."""
DAMPING = 1e-3
"""Adam's ε. An entry of a fine grid that one point alone asks for has a gradient far below this, and hardly
moves. With the usual 1e-15 it leaps by the whole rate: normals at the surface were then 12.5° off those of
the hull, in place of 6°, and second derivatives four times as large.
"""
POOL = 65_536
"""Points of the cube among which those near the surface are sought."""


@dataclass(frozen=True)
class GeometryStart:
    """What the field starts as. `error` is the mean difference between field and hull at the hull's surface,
    scene units; none: it starts as a sphere, for the `reason`. `warning`: masks are there, and no body comes
    of them.
    """

    views: int = 0
    error: float | None = None
    reason: str = ""
    warning: bool = False

    @property
    def text(self) -> str:
        """For people, in a line."""
        if self.error is None:
            return f"{'warning: ' * self.warning}geometry starts as a sphere: {self.reason}"
        return f"geometry starts as the visual hull of {self.views} masks, to {self.error:.3f} scene units"


def start_geometry(model: NeilfModel, capture: Capture, config: NeilfConfig) -> GeometryStart | None:
    """Give a new model the geometry that `config.host.sdf.start` names, and say which it is.

    None where there is nothing to start: geometry is given, or belongs to another trainer. Only views to
    train on are asked. The outcome follows from `config.train.seed` and the masks alone, and no other random
    number is moved by it.

    Raises:
        UserError: a mask cannot be read.
    """
    if not isinstance(model.host, VolSdfHost):
        return None
    if config.host.sdf.start == "sphere":
        return GeometryStart(reason="as the settings say")
    outlines = [_in_scene(outline, capture) for outline in read_outlines(capture.train_views, HULL_VIEWS)]
    if not outlines:
        return GeometryStart(reason="the capture has no masks")
    hull = find_hull(outlines)
    if isinstance(hull, str):
        return GeometryStart(reason=hull, warning=True)
    error = fit_distance(model.host.sdf_field, hull, config.volume.radius, config.train.seed, _rate(config))
    return GeometryStart(len(outlines), error)


def fit_distance(
    field: SdfField, target: DistanceCube, radius: float, seed: int, rate: float = RATE
) -> float:
    """Fit a distance field to a sampled distance within `radius`; returns the mean error at its surface.

    The L1 error of the distance is minimised at points that are half spread over the ball and half about the
    surface. Features of the field, which R reads, are not asked for and move as they like.

    Args:
        field: moves in place, on its own device.
        target: what it is brought to.
        radius: of the ball, scene units.
        seed: of the points.
        rate: of Adam.
    """
    device = next(field.parameters()).device
    points = torch.Generator().manual_seed(
        seed
    )  # its own: what training draws does not depend on how it started
    surface = _surface_points(target, points)
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


def _surface_points(target: DistanceCube, generator: torch.Generator) -> Float[Tensor, "P 3"]:
    """Points of the cube within two cells of the surface."""
    x = target.radius * (2 * torch.rand(POOL, 3, generator=generator) - 1)
    nearest = target.at(x).abs()
    # A body of a few cells has few points near it: the nearest hundredth of the pool serves then.
    return x[
        nearest
        <= torch.maximum(
            torch.tensor(4 * target.radius / len(target.distance)), nearest.kthvalue(POOL // 100)[0]
        )
    ]


def _in_ball(count: int, radius: float, generator: torch.Generator) -> Float[Tensor, "N 3"]:
    """Points spread evenly over a ball."""
    direction = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator), dim=-1)
    return radius * torch.rand(count, 1, generator=generator) ** (1 / 3) * direction


def _in_scene(outline: Outline, capture: Capture) -> Outline:
    return replace(
        outline, view=replace(outline.view, camera=capture.normalisation.camera(outline.view.camera))
    )


def _rate(config: NeilfConfig) -> float:
    return RATE if config.encoding.kind == "hash" else RATE / 10
