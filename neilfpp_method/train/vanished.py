"""Bring back a surface that has vanished at the start of training.

The distance field G starts as a sphere, and R is untrained. If a background of one colour is closer to the
photographs than R, the first steps remove the sphere: G becomes positive everywhere, by many widths of the
surface. Then no gradient reaches G or R, and the training stays empty. In a room without masks, whether this
happened depended on the random seed: held-back pixels had 15 dB, or 32 dB.

G is then lowered until a tenth of the unit sphere is inside. The details that G has learned remain, and R has
learned something meanwhile, so surfaces form again.
"""

from __future__ import annotations

import torch

from neilfpp_method.hosts.base import Host
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.schedule import Stage, StagePosition

__all__ = ["restore_surface"]

STEPS_BETWEEN_CHECKS = 20
"""Number of steps between two checks."""
LAST_CHECKED_SHARE = 0.5
"""Share of SDF init up to which the surface is checked."""
GRID = 32
"""Points along an edge of the checked grid over the scene sphere; it does not miss a ball of radius 0.05."""
MAX_DISTANCE_IN_WIDTHS = 6.0
"""Distance from the surface, in units of β, beyond which nothing is learned: the density is e⁻⁶ of that on
the surface.
"""
RESTORED_SHARE = 0.1
"""Share of the volume of the unit sphere that lies inside the restored surface. 0.05 and 0.1 gave the same
quality.
"""


@torch.no_grad()
def restore_surface(host: Host, position: StagePosition) -> bool:
    """Restore the surface of a host if it has vanished, and tell whether it had.

    Hosts without a distance field that started as a sphere are not changed.

    Args:
        host: the host, after an optimizer step.
        position: the stage, and the number of steps trained in it.
    """
    is_due = (
        position.stage is Stage.SDF_INIT
        and position.step % STEPS_BETWEEN_CHECKS == 0
        and position.share < LAST_CHECKED_SHARE
    )
    if not is_due or not isinstance(host, VolSdfHost) or host.starts_from_shape:
        return False
    radius = host.radius
    axis = torch.linspace(-radius, radius, GRID, device=host.distance_grid.device)
    points = torch.cartesian_prod(axis, axis, axis)
    points = points[points.norm(dim=-1) < radius]
    distance = host.sdf_field(points).float()
    if distance.min() <= MAX_DISTANCE_IN_WIDTHS * host.surface_width():
        return False
    host.sdf_field.lower_(float(distance[points.norm(dim=-1) < 1.0].quantile(RESTORED_SHARE)))
    if host.empty_space is not None:
        host.empty_space.age = None
    return True
