"""The optional methods of a host: who asks for each, and what happens without it.

`python -m neilfpp_method.hosts.capabilities` prints the table of docs/hosts.md.
"""

from __future__ import annotations

from dataclasses import dataclass

from neilfpp_method.hosts import base

__all__ = ["CAPABILITIES", "Capability", "markdown"]


@dataclass(frozen=True)
class Capability:
    """An optional method, or attribute, of a host.

    Attributes:
        method: its name.
        protocol: the class of `hosts.base` that has its signature.
        asked_by: who asks for it, for people.
        module: the module of this package that does.
        without: what happens without it, a clause.
        told: whether `attach_neilf` says that a host lacks it; the rest few hosts can have.
    """

    method: str
    protocol: type
    asked_by: str
    module: str
    without: str
    told: bool = False


CAPABILITIES = (
    Capability(
        "parameter_groups",
        base.HasParameterGroups,
        "optimisers of the training loops",
        "model",
        "its own trainer moves it",
        told=True,
    ),
    Capability(
        "render_regularised",
        base.Regularised,
        "training steps that move the host",
        "model",
        "no losses of its own on the geometry",
        told=True,
    ),
    Capability(
        "scene_light",
        base.LightsItself,
        "hard inter-reflection, shadows, the fit of map and lamps",
        "incident.scene",
        "hard inter-reflection is traced by a proxy",
        told=True,
    ),
    Capability(
        "radiance",
        base.KnowsRadiance,
        "the proxy",
        "hosts.foreign",
        "surfaces send each other the mean of what the training rays saw there",
    ),
    Capability(
        "surface_width",
        base.HasSurfaceWidth,
        "L_ref",
        "incident.scene",
        "rays for L_ref start at a fixed distance from the surface",
        told=True,
    ),
    Capability(
        "may_meet",
        base.KnowsMisses,
        "L_ref",
        "incident.traced",
        "every ray for L_ref is rendered",
    ),
    Capability(
        "smooth_normals",
        base.SmoothsNormals,
        "shading",
        "model",
        "surfaces are shaded with the normals of the hits",
    ),
    Capability(
        "sdf",
        base.HasSdf,
        "`neilfpp export`, Chamfer distances",
        "export.mesh",
        "no mesh to export",
        told=True,
    ),
    Capability(
        "read_outputs",
        base.ReadsOutputs,
        "`losses` and `maps` with what is rendered already",
        "hosts.answers",
        "a dictionary is read by usual names (`hosts.answers`)",
    ),
    Capability(
        "stages",
        base.HasStages,
        "training loops",
        "model",
        "the stages of the paper; of a borrowed host those with a material",
    ),
)
"""In the order of what they bring."""


def markdown() -> str:
    """The table for people."""
    rows = [f"| `{c.method}` | {c.asked_by} | {c.without} |" for c in CAPABILITIES]
    return "\n".join(["| optional | asked for by | without it |", "|---|---|---|", *rows])


if __name__ == "__main__":
    print(markdown())
