"""Convert rendered outputs of a host to `SurfaceHits`.

| form                      | conversion                                                   |
|---------------------------|--------------------------------------------------------------|
| `SurfaceHits`             | none                                                         |
| dictionary                | by the host's `read_outputs`, else by the names below        |
| named tuple               | as a dictionary, if it has a colour and a normal by name     |
| (color, position, normal) | as the result of a function: a ray with a zero normal misses |

| field         | names in a dictionary                                                             |
|---------------|-----------------------------------------------------------------------------------|
| color         | `color`, `rgb`: linear radiance                                                   |
| position      | `position`; or `depth`, a distance along the unit ray                             |
| normal        | `normal`, `normals`: vectors of any length                                        |
| opacity       | `opacity`, `accumulation`, `alpha`, (N,) or (N, 1); else 1 if the normal is not 0 |
| concentration | `concentration`; else the opacity                                                 |

A ray without opacity misses, so its position is not read: many hosts return an infinite depth there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from neilfpp_method.errors import UserError
from neilfpp_method.hosts.base import ReadsOutputs
from neilfpp_method.hosts.outputs import check_tensors, host_name
from neilfpp_method.shading.frame import safe_normalize
from neilfpp_method.structures import RayBatch, SurfaceHits

__all__ = ["Rendered", "as_hits", "function_hits", "given_depth", "no_hits"]

Rendered = SurfaceHits | Mapping[str, Tensor] | Sequence[Tensor]
"""Rendered outputs of a host, in any form that this module reads."""

COLOR, POSITION, DEPTH, NORMAL = ("color", "rgb"), ("position",), ("depth",), ("normal", "normals")
OPACITY, CONCENTRATION = ("opacity", "accumulation", "alpha"), ("concentration",)


def as_hits(host: object, rays: RayBatch, rendered: Any) -> SurfaceHits:
    """Convert what a host rendered for rays, in any form of `Rendered`, to hits; see the tables above.

    Example:
        >>> hits = as_hits(host, rays, {"rgb": rgb, "depth": depth, "normal": normal, "accumulation": alpha})

    Raises:
        UserError: an output is missing, or its shape does not match the rays.
    """
    name = host_name(host)
    if _has_names(rendered):
        rendered = rendered._asdict()
    if isinstance(rendered, Mapping):
        reads = isinstance(host, ReadsOutputs)
        hits = host.read_outputs(rays, rendered) if reads else _from_dictionary(name, rays, rendered)
    elif all(hasattr(rendered, f.name) for f in fields(SurfaceHits)):
        hits = rendered
    else:
        hits = function_hits(name, rays, rendered)
    check_tensors(name, rays, {f.name: getattr(hits, f.name, None) for f in fields(SurfaceHits)})
    return hits


def function_hits(name: str, rays: RayBatch, returned: Any) -> SurfaceHits:
    """Convert (color, position, normal), each (N, 3), to hits.

    Args:
        name: name of the function, for error messages.
        rays: the rays that it was called with.
        returned: what it returned.

    Raises:
        UserError: these are not three tensors of the right shape on the device of the rays.
    """
    if not isinstance(returned, tuple | list) or len(returned) != 3:
        is_list = isinstance(returned, tuple | list)
        kind = f"{len(returned)} values" if is_list else f"a {type(returned).__name__}"
        raise UserError(
            f"{name}: returns {kind}", "return color, position and normal, each (N, 3), or a dictionary"
        )
    check_tensors(name, rays, dict(zip(("color", "position", "normal"), returned, strict=True)))
    color, position, normal = returned
    # The comparison is False for NaN.
    hit = normal.detach().square().sum(-1) > 0.25
    position = torch.where(hit[:, None], position, rays.origins.to(position.dtype))
    share = hit.to(color.dtype)
    return SurfaceHits(color, position, torch.where(hit[:, None], normal, 0.0), share, share)


def given_depth(rendered: Any) -> Tensor | None:
    """The depths of rendered outputs by name; None if there are none, or none are read.

    Positions are computed from them in the precision of the rays, so they show only here how coarse they are.
    """
    outputs = rendered._asdict() if _has_names(rendered) else rendered
    if not isinstance(outputs, Mapping) or _optional(outputs, POSITION) is not None:
        return None
    depth = _optional(outputs, DEPTH)
    return depth if isinstance(depth, Tensor) else None


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
    check_tensors(name, rays, {"position": position})
    position = torch.where(opacity.detach()[:, None] > 0, position, rays.origins.to(position.dtype))
    concentration = _optional(outputs, CONCENTRATION)
    known = opacity.detach() if concentration is None else _column(name, "concentration", rays, concentration)
    return SurfaceHits(color, position, normal, opacity, known)


def _has_names(rendered: object) -> bool:
    """Whether this is a named tuple whose names identify color and normal, in any order."""
    names = getattr(rendered, "_fields", ())
    return all(any(name in names for name in group) for group in (COLOR, NORMAL))


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
