"""The state that the checks of `hosts.testing` share: a host under test, its rays and its hits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from neilfpp_method.errors import UserError
from neilfpp_method.hosts.base import HasSurfaceWidth, Host
from neilfpp_method.hosts.conversion import as_hits
from neilfpp_method.structures import RayBatch, SurfaceHits

__all__ = ["HIT_SHARE", "Case", "ContractBroken", "Modes", "render_checked"]

HIT_SHARE = 0.8
"""Smallest concentration of a hit, as in the presets."""


class ContractBroken(AssertionError):
    """A host breaks the contract; `check` names the check that found it."""

    check = "tensors"


@dataclass(frozen=True)
class Modes:
    """Train/eval mode of a host's modules, and `requires_grad` of its parameters."""

    training: tuple[bool, ...]
    requires_grad: tuple[bool, ...]

    @staticmethod
    def of(modules: Sequence[nn.Module], parameters: Sequence[nn.Parameter]) -> Modes:
        """Record the current modes."""
        parts = [part for module in modules for part in module.modules()]
        return Modes(tuple(part.training for part in parts), tuple(p.requires_grad for p in parameters))

    def restore(self, modules: Sequence[nn.Module], parameters: Sequence[nn.Parameter]) -> None:
        """Restore the recorded modes."""
        for part, training in zip(
            (p for module in modules for p in module.modules()), self.training, strict=True
        ):
            part.training = training
        for parameter, requires_grad in zip(parameters, self.requires_grad, strict=True):
            parameter.requires_grad_(requires_grad)


@dataclass(frozen=True)
class Case:
    """A host under test, with rays and the hits that it rendered.

    Attributes:
        host: the host under test.
        name: name of the host in messages.
        before: modes of the host before it was called for the first time.
        now: returns the current modes of the host.
        rays: the rays.
        parameters: the parameters that the host trains.
        trains_geometry: whether L_phys may move its surface.
        hits: what the host rendered for the rays.
        hit: which rays hit a surface.
    """

    host: Host
    name: str
    before: Modes
    now: Callable[[], Modes]
    rays: RayBatch
    parameters: Sequence[nn.Parameter]
    trains_geometry: bool
    hits: SurfaceHits
    hit: Tensor

    def require(self, passed: bool | Tensor, broken: str) -> None:
        """Raise `ContractBroken` with the message `broken` unless `passed` is true."""
        if not passed:
            raise ContractBroken(f"{self.name}: {broken}")

    def seeded(self, rays: RayBatch, seed: int = 0) -> SurfaceHits:
        """Render rays after seeding; the random state is restored."""
        with torch.random.fork_rng(devices=[rays.origins.device] if rays.origins.is_cuda else []):
            torch.manual_seed(seed)
            return render_checked(self.host, rays)

    def constants(self, rays: RayBatch, seed: int = 0) -> SurfaceHits:
        """As `seeded`, without gradients."""
        with torch.no_grad():
            return self.seeded(rays, seed).detach()

    @property
    def width(self) -> float:
        """Width of the surface layer, scene units; 0 if the host has no `surface_width`."""
        return float(self.host.surface_width()) if isinstance(self.host, HasSurfaceWidth) else 0.0


def render_checked(host: Host, rays: RayBatch) -> SurfaceHits:
    """Render rays, and check shapes, types and devices of the result.

    Raises:
        ContractBroken: rendering fails with a `UserError`, or the result is invalid.
    """
    try:
        return as_hits(host, rays, host.render(rays))
    except UserError as error:
        raise ContractBroken(str(error)) from error
