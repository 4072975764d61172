"""The optional methods of a host: what uses each, and what happens without it.

`python -m neilfpp_method.hosts.capabilities` prints the table of docs/hosts.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from neilfpp_method.hosts import base

__all__ = ["CAPABILITIES", "Capability", "markdown", "missing_capabilities"]


@dataclass(frozen=True)
class Capability:
    """An optional method, or attribute, of a host.

    Attributes:
        method: name of the method.
        protocol: the protocol in `hosts.base` with its signature.
        used_by: description of what uses it, for the documentation.
        module: the module of this package that uses it.
        without: what happens without it, a clause.
        reported: whether `attach_neilf` logs that a host lacks it. False for methods that few hosts can have.
    """

    method: str
    protocol: type
    used_by: str
    module: str
    without: str
    reported: bool = False


CAPABILITIES = (
    Capability(
        "parameter_groups",
        base.HasParameterGroups,
        "the optimizer of the training loop",
        "model",
        "the host is trained by its own trainer, or not at all",
        reported=True,
    ),
    Capability(
        "render_regularized",
        base.Regularized,
        "training steps that train the host",
        "model",
        "the geometry has no losses of the host's own",
        reported=True,
    ),
    Capability(
        "scene_light",
        base.TracesLight,
        "hard inter-reflection, shadow rays, the fit of environment map and lamps",
        "incident.scene",
        "a proxy traces hard inter-reflection",
        reported=True,
    ),
    Capability(
        "radiance",
        base.HasRadiance,
        "the proxy",
        "hosts.foreign",
        "light between surfaces is the mean radiance that training rays saw there",
    ),
    Capability(
        "surface_width",
        base.HasSurfaceWidth,
        "L_ref",
        "incident.scene",
        "rays for L_ref start at a fixed distance from the surface",
        reported=True,
    ),
    Capability(
        "limit_surface_width",
        base.LimitsSurfaceWidth,
        "training loops",
        "train.optimizer",
        "the width of the surface depends only on the host's own training",
    ),
    Capability(
        "starts_from_shape",
        base.StartsFromShape,
        "training loops",
        "train.optimizer",
        "geometry is trained from the first step",
    ),
    Capability(
        "may_hit",
        base.PredictsMisses,
        "L_ref",
        "incident.traced",
        "every ray for L_ref is rendered",
    ),
    Capability(
        "smooth_normals",
        base.SmoothsNormals,
        "shading",
        "model",
        "surfaces are shaded with the hit normals",
    ),
    Capability(
        "sdf",
        base.HasSdf,
        "`neilfpp export`, Chamfer distances",
        "export.mesh",
        "no mesh can be exported",
        reported=True,
    ),
    Capability(
        "points",
        base.HasPointCloud,
        "health checks",
        "health.measure",
        "the surface is not compared with a point cloud",
    ),
    Capability(
        "read_outputs",
        base.ReadsOutputs,
        "`losses` and `maps`, if they are given rendered outputs",
        "hosts.conversion",
        "a dictionary is read by common names (`hosts.conversion`)",
    ),
    Capability(
        "stages",
        base.HasStages,
        "training loops",
        "model",
        "the paper's stages; for a borrowed host those that train material",
    ),
)
"""All optional methods, the most useful first."""


def missing_capabilities(host: object) -> Mapping[str, str]:
    """The optional methods that most hosts could have and this one lacks, with the consequence of each."""
    return {c.method: c.without for c in CAPABILITIES if c.reported and not hasattr(host, c.method)}


def markdown() -> str:
    """The table of docs/hosts.md."""
    rows = [f"| `{c.method}` | {c.used_by} | {c.without} |" for c in CAPABILITIES]
    return "\n".join(["| optional | used by | without it |", "|---|---|---|", *rows])


if __name__ == "__main__":
    print(markdown())
