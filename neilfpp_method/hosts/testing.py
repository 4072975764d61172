"""A test suite of the host contract for authors of hosts: `check_host(host, rays)`.

`testing_geometry` checks that surfaces are the same from several viewpoints. `testing_conduct` checks that
results do not depend on the batch and that rendering has no side effects. The other checks are in this
module. docs/hosts.md lists which of a set of planted defects the suite finds.

The suite cannot determine whether colours are linear, which would need a photograph with known radiance. It
does detect the most common symptom: colours that are clipped at 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial

import torch
from torch import Tensor, nn

from neilfpp_method.errors import UserError
from neilfpp_method.hosts.adapt import adapt
from neilfpp_method.hosts.base import HasStages, Host
from neilfpp_method.hosts.outputs import check_normals, host_name
from neilfpp_method.hosts.testing_case import HIT_SHARE, Case, ContractBroken, Modes, render_checked
from neilfpp_method.hosts.testing_conduct import BASIC_CHECKS, CONDUCT_CHECKS
from neilfpp_method.hosts.testing_geometry import GEOMETRY_CHECKS
from neilfpp_method.schedule import STAGES
from neilfpp_method.structures import RayBatch, SurfaceHits

__all__ = ["ContractBroken", "HostReport", "check_host"]

OFF_RAY = 1e-2
"""Largest distance of a hit from its ray, relative to its distance from the origin of the ray."""
MIN_FACING_SHARE = 0.9
"""Smallest share of hits whose normal must face the viewer; blended normals at silhouettes may face away."""
MAX_CLIPPED_SHARE = 0.01
"""Share of colour values of exactly 1, if that is their maximum, above which colours count as clipped."""
FAR_DISTANCE = 100.0
"""Distance from which rays start that lead away from the scene, scene units."""


@dataclass(frozen=True)
class HostReport:
    """Result for a host that passed: hits, rays, the checks, and whether its geometry is trained."""

    host: str
    hits: int
    rays: int
    checks: tuple[str, ...]
    trains_geometry: bool


def check_host(host: object, rays: RayBatch, parameters: Sequence[nn.Parameter] | None = None) -> HostReport:
    """Check that a host keeps the contract of `hosts.base.Host`.

    Args:
        host: what `attach_neilf` accepts, if it renders rays: a host, or a function (origins, directions) →
            (color, position, normal). Its train/eval mode is not changed.
        rays: some hundred rays in the scene frame, from outside of the object; several must hit it.
        parameters: the parameters that the host trains; if None, all its parameters, if it is a module.

    Raises:
        ContractBroken: the host breaks the contract (an AssertionError that names the host and the defect).
        UserError: it is not a host, or draws whole images instead of rays.

    Example:
        >>> print(check_host(my_function, RayBatch(origins, directions)))
    """
    modules = [part for part in (host, getattr(host, "__self__", None)) if isinstance(part, nn.Module)]
    host = adapt(host, "linear")
    if not isinstance(host, Host):
        raise UserError(
            f"{host_name(host)} draws whole images, and these checks render single rays",
            "train some steps: losses(batch, step, hits) checks the first ten batches",
        )
    if parameters is None:
        parameters = [p for module in modules for p in module.parameters()]
    parameters = [p for p in parameters if p.requires_grad]
    name = host_name(host)
    copy = rays.map(Tensor.clone)
    before = Modes.of(modules, parameters)
    try:
        hits = render_checked(host, rays)
        stages = host.stages if isinstance(host, HasStages) else STAGES
        trains_geometry = bool(parameters) and any("geometry" in plan.trains for plan in stages.values())
        hit = hits.is_hit(HIT_SHARE).detach()
        now = partial(Modes.of, modules, parameters)
        case = Case(host, name, before, now, rays, parameters, trains_geometry, hits, hit)
        unchanged = torch.equal(copy.origins, rays.origins) and torch.equal(copy.directions, rays.directions)
        case.require(unchanged, "changes its input")
        _run(case)
    finally:
        before.restore(modules, parameters)
    names = ("tensors", *(check.__name__.strip("_") for check in CHECKS))
    return HostReport(name, int(case.hit.sum()), len(rays), names, trains_geometry)


def _run(case: Case) -> None:
    for check in CHECKS:
        try:
            check(case)
        except ContractBroken as broken:
            broken.check = check.__name__.strip("_")
            raise


# ----------------------------------------------------------------------------------------------------- checks


def _precision(case: Case) -> None:
    for field in fields(SurfaceHits):
        dtype, wanted = getattr(case.hits, field.name).dtype, case.rays.origins.dtype
        case.require(dtype == wanted, f"its {field.name} is {dtype}, the rays are {wanted}")


def _hits(case: Case) -> None:
    case.require(
        case.hit.any(), f"{len(case.rays)} rays hit nothing: aim them at the surface, in the scene frame"
    )
    for share in ("opacity", "concentration"):
        value = getattr(case.hits, share).detach()
        case.require(((value >= 0.0) & (value <= 1.0 + 1e-3)).all(), f"its {share} is outside of [0, 1]")
    solid = case.hits.opacity.detach()[case.hit].median().item()
    case.require(
        solid > 0.5,
        f"its opacity is {solid:.2g} where it says that rays hit: images would show no surface there",
    )


def _normals(case: Case) -> None:
    try:
        check_normals(case.name, case.hits, HIT_SHARE)
    except UserError as error:
        raise ContractBroken(str(error)) from error
    facing = (case.hits.normal.detach() * case.rays.directions).sum(-1)[case.hit] < 0.0
    share = facing.float().mean().item()
    case.require(
        share >= MIN_FACING_SHARE,
        f"{1.0 - share:.0%} of its normals point away from the viewer: turned inwards?",
    )


def _positions(case: Case) -> None:
    offset = (case.hits.position.detach() - case.rays.origins)[case.hit]
    directions = case.rays.directions[case.hit]
    depth = (offset * directions).sum(-1)
    case.require((depth > 0.0).all(), "hits lie behind the origin of their ray")
    beside = (offset - depth[:, None] * directions).norm(dim=-1)
    case.require(
        (beside <= OFF_RAY * depth).all(), "hits do not lie on their ray: is the depth a distance along it?"
    )


def _colors(case: Case) -> None:
    color = case.hits.color.detach()
    case.require(color.isfinite().all(), "its color is not finite")
    case.require((color >= 0.0).all(), "its color is negative")
    colors = color[case.hit]
    clipped = (colors == 1.0).float().mean().item()
    stops = colors.max() == 1.0 and MAX_CLIPPED_SHARE < clipped < 1.0
    case.require(
        not stops, f"{clipped:.0%} of its colors are exactly 1 and none is above: return them unclipped"
    )


def _misses(case: Case) -> None:
    outward = -case.rays.directions
    away = RayBatch(case.rays.origins + FAR_DISTANCE * outward, outward)
    missed = render_checked(case.host, away)
    for field in fields(SurfaceHits):
        finite = getattr(missed, field.name).isfinite().all()
        case.require(finite, f"its {field.name} is not finite for a ray that misses")
    case.require(not missed.is_hit(HIT_SHARE).any(), "rays that lead away from the scene hit something")
    case.require((missed.opacity < 0.5).all(), "its opacity is high for rays that lead away from the scene")


def _gradients_flow(case: Case) -> None:
    if not case.parameters:
        return
    case.require(
        _reaches(case, case.hits.color[case.hit]), "no gradient flows from its color to its parameters"
    )
    if case.trains_geometry:
        shape = torch.cat([case.hits.position[case.hit], case.hits.normal[case.hit]], dim=-1)
        case.require(
            _reaches(case, shape), "no gradient flows from its hits to its parameters: L_phys cannot train it"
        )


def _gradients_stop(case: Case) -> None:
    before = [p.grad for p in case.parameters]
    with torch.no_grad():
        held = render_checked(case.host, case.rays)
    for field in fields(SurfaceHits):
        leaks = getattr(held, field.name).requires_grad
        case.require(not leaks, f"its {field.name} carries a gradient under torch.no_grad: detach it there")
    unchanged = all(p.requires_grad and p.grad is g for p, g in zip(case.parameters, before, strict=True))
    case.require(unchanged, "rendering changes requires_grad or grad of its parameters")


def _reaches(case: Case, output: Tensor) -> bool:
    """Whether a gradient of the output reaches a parameter; it must be finite."""
    if not output.requires_grad:
        return False
    # Weights of both signs: a plain sum may be constant, like the sum of squares of a unit vector.
    weights = torch.linspace(-1.0, 1.5, output.numel(), dtype=output.dtype, device=output.device).reshape(
        output.shape
    )
    gradients = torch.autograd.grad(
        (weights * output).sum(), case.parameters, retain_graph=True, allow_unused=True
    )
    found = [g for g in gradients if g is not None]
    case.require(all(g.isfinite().all() for g in found), "a gradient of its parameters is not finite")
    return any(bool(g.abs().max() > 0.0) for g in found)


CHECKS: tuple[Callable[[Case], None], ...] = (
    _precision,
    _hits,
    _normals,
    _positions,
    _colors,
    *BASIC_CHECKS,
    *GEOMETRY_CHECKS,
    _misses,
    *CONDUCT_CHECKS,
    _gradients_flow,
    _gradients_stop,
)
