"""Convert rendered outputs of a host to `SurfaceHits`.

| form                      | conversion                                                   |
|---------------------------|--------------------------------------------------------------|
| `SurfaceHits`             | none                                                         |
| dictionary                | by the host's `read_outputs`, else by the names below        |
| (color, position, normal) | as the result of a function: a ray with a zero normal misses |

| field         | names in a dictionary                                                             |
|---------------|-----------------------------------------------------------------------------------|
| color         | `color`, `rgb`: linear radiance                                                   |
| position      | `position`; or `depth`, a distance along the unit ray                             |
| normal        | `normal`, `normals`: vectors of any length                                        |
| opacity       | `opacity`, `accumulation`, `alpha`, (N,) or (N, 1); else 1 if the normal is not 0 |
| concentration | `concentration`; else the opacity                                                 |
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.errors import UserError
from neilfpp_method.hosts.base import ReadsOutputs
from neilfpp_method.hosts.function import function_hits
from neilfpp_method.hosts.outputs import check_tensors, host_name
from neilfpp_method.shading.frame import safe_normalize
from neilfpp_method.structures import RayBatch, SurfaceHits

__all__ = ["Rendered", "as_hits", "in_precision", "no_hits"]

Rendered = SurfaceHits | Mapping[str, Tensor] | Sequence[Tensor]
"""Rendered outputs of a host, in any form that this module reads."""

COLOR, POSITION, DEPTH, NORMAL = ("color", "rgb"), ("position",), ("depth",), ("normal", "normals")
OPACITY, CONCENTRATION = ("opacity", "accumulation", "alpha"), ("concentration",)


def as_hits(host: object, rays: RayBatch, rendered: Rendered) -> SurfaceHits:
    """Convert what a host rendered for rays to hits; see the tables of this module.

    Example:
        >>> hits = as_hits(host, rays, {"rgb": rgb, "depth": depth, "normal": normal, "accumulation": alpha})

    Raises:
        UserError: an output is missing, or its shape does not match the rays.
    """
    name = host_name(host)
    if isinstance(rendered, Mapping):
        reads = isinstance(host, ReadsOutputs)
        hits = host.read_outputs(rays, rendered) if reads else _from_dictionary(name, rays, rendered)
    elif isinstance(rendered, tuple | list):
        hits = function_hits(name, rays, rendered)
    else:
        hits = rendered
    check_tensors(name, rays, {f.name: getattr(hits, f.name, None) for f in fields(SurfaceHits)})
    return hits


def in_precision(hits: SurfaceHits, dtype: torch.dtype) -> SurfaceHits:
    """Convert hits to a floating-point type, keeping gradients."""
    return replace(hits, **{f.name: getattr(hits, f.name).to(dtype) for f in fields(hits)})


def no_hits(rays: RayBatch) -> SurfaceHits:
    """Hits in which every ray misses: black, with its position at the origin of the ray."""
    nothing, zero = torch.zeros_like(rays.origins), torch.zeros_like(rays.origins[:, 0])
    return SurfaceHits(nothing, rays.origins, nothing, zero, zero)


def _from_dictionary(name: str, rays: RayBatch, outputs: Mapping[str, Tensor]) -> SurfaceHits:
    color = _first(name, outputs, COLOR)
    normal = safe_normalize(_first(name, outputs, NORMAL))
    position = _optional(outputs, POSITION)
    if position is None:
        depth = _column(name, "depth", rays, _first(name, outputs, (*POSITION, *DEPTH)))
        position = rays.origins + depth[:, None] * rays.directions
    opacity = _optional(outputs, OPACITY)
    opacity = normal.detach().norm(dim=-1) if opacity is None else _column(name, "opacity", rays, opacity)
    concentration = _optional(outputs, CONCENTRATION)
    known = opacity.detach() if concentration is None else _column(name, "concentration", rays, concentration)
    return SurfaceHits(color, position, normal, opacity, known)


def _optional(outputs: Mapping[str, Tensor], names: Sequence[str]) -> Tensor | None:
    return next((outputs[name] for name in names if name in outputs), None)


def _first(name: str, outputs: Mapping[str, Tensor], names: Sequence[str]) -> Tensor:
    value = _optional(outputs, names)
    if isinstance(value, Tensor):
        return value
    wanted = " or ".join(f"'{wanted}'" for wanted in names)
    held = ", ".join(outputs) or "nothing"
    raise UserError(f"{name}: its outputs have no tensor {wanted}, but {held}", "add one, a row per ray")


def _column(name: str, output: str, rays: RayBatch, value: Tensor) -> Float[Tensor, " N"]:
    """One number per ray, given as (N,) or (N, 1)."""
    if value.shape not in ((len(rays),), (len(rays), 1)):
        raise UserError(
            f"{name}: its {output} has the shape {tuple(value.shape)}",
            f"return ({len(rays)},), a number per ray",
        )
    return value.reshape(-1)
