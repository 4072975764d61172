"""Checks of a host's behaviour: results do not depend on the batch, and there are no side effects."""

from __future__ import annotations

from dataclasses import fields

import torch
from torch import Tensor

from neilfpp_method.hosts.testing_case import Case
from neilfpp_method.structures import RayBatch, SurfaceHits

__all__ = ["BASIC_CHECKS", "CONDUCT_CHECKS"]

MAX_CHANGE = 0.005
"""Largest permitted median change of positions between two calls, in scene units. The width of the soft layer
is added to it.
"""
MAX_RELATIVE_DIFFERENCE = 3.0
"""Largest permitted difference between a ray rendered in a part of a batch and in the whole batch, relative
to the difference between two calls.
"""


def _one_ray(case: Case) -> None:
    row = int(case.hit.nonzero()[0])
    try:
        # Rendering checks the shapes.
        case.constants(case.rays[row : row + 1])
    except AssertionError as error:
        raise type(error)(f"{error} (with one ray)") from error
    except Exception as error:
        case.require(False, f"cannot render a single ray ({error})")


def _one_camera(case: Case) -> None:
    row = int(case.hit.nonzero()[0])
    shared = RayBatch(case.rays.origins[row].expand(4, 3), case.rays.directions[row].expand(4, 3))
    try:
        case.constants(shared)
    except Exception as error:
        case.require(False, f"cannot render rays that share their origin in memory ({error})")


def _independent_of_batch(case: Case) -> None:
    whole, other = case.constants(case.rays), case.constants(case.rays, seed=1)
    for rows in (slice(0, None, 3), torch.arange(len(case.rays), device=case.hit.device).flip(0)):
        part = case.constants(case.rays[rows])
        for name in ("color", "position", "normal", "opacity"):
            together = getattr(whole, name)[rows]
            noise = (getattr(whole, name) - getattr(other, name)).abs().mean()
            room = MAX_RELATIVE_DIFFERENCE * noise + 1e-4 + 1e-3 * together.abs().mean()
            off = (getattr(part, name) - together).abs().mean()
            case.require(off <= room, f"its {name} of a ray depends on which other rays are in the batch")


def _repeatable(case: Case) -> None:
    first, second = case.constants(case.rays), case.constants(case.rays)
    for field in fields(SurfaceHits):
        same = torch.allclose(
            getattr(first, field.name), getattr(second, field.name), rtol=1e-4, atol=1e-6, equal_nan=True
        )
        what = f"renders differently after the same seed ({field.name})"
        case.require(same, f"{what}: draw from torch's global generator")
    other = case.constants(case.rays, seed=1)
    moved = (other.position - first.position)[case.hit].norm(dim=-1).median().item()
    broken = (
        f"half of its positions change by {moved:.2g} or more between calls: "
        "reduce the noise, or use more samples"
    )
    case.require(moved <= MAX_CHANGE + case.width, broken)


def _same_without_gradient(case: Case) -> None:
    with torch.enable_grad():
        recorded = case.seeded(case.rays).detach()
    for name in ("color", "position", "normal"):
        same = torch.allclose(
            getattr(recorded, name), getattr(case.constants(case.rays), name), rtol=1e-3, atol=1e-4
        )
        case.require(same, f"its {name} differs under torch.no_grad")


def _returns_copies(case: Case) -> None:
    first = case.constants(case.rays)
    copies = [getattr(first, field.name).clone() for field in fields(SurfaceHits)]
    case.constants(RayBatch(case.rays.origins, case.rays.directions.roll(1, dims=0)))
    for field, before in zip(fields(SurfaceHits), copies, strict=True):
        same = torch.equal(getattr(first, field.name), before)
        case.require(same, f"its {field.name} changes when it renders again: return a copy, not a buffer")


def _preserves_modes(case: Case) -> None:
    now = case.now()
    case.require(
        now.training == case.before.training, "rendering calls train() or eval(): leave the mode unchanged"
    )
    unchanged = now.requires_grad == case.before.requires_grad
    case.require(unchanged, "rendering changes requires_grad of its parameters")
    grad, dtype = torch.is_grad_enabled(), torch.get_default_dtype()
    case.host.render(case.rays)
    left = torch.is_grad_enabled() == grad and torch.get_default_dtype() == dtype
    torch.set_grad_enabled(grad)
    torch.set_default_dtype(dtype)
    case.require(left, "rendering leaves torch's gradient mode or default type changed: use a context")


def _preserves_random_state(case: Case) -> None:
    case.require(
        not torch.equal(_next_draw(case, 1), _next_draw(case, 2)),
        "calls torch.manual_seed: leave seeding to the caller",
    )


def _next_draw(case: Case, seed: int) -> Tensor:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        case.host.render(case.rays)
        return torch.rand(4)


BASIC_CHECKS = (_preserves_modes, _one_ray, _one_camera, _repeatable)
"""Checks of what the checks of the geometry rely on: any rays can be rendered, repeatedly."""
CONDUCT_CHECKS = (_independent_of_batch, _same_without_gradient, _returns_copies, _preserves_random_state)
"""All other checks of the behaviour."""
