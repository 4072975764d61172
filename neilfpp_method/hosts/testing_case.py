"""A host under test, and how the checks of `hosts.testing` look at it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor, nn

from neilfpp_method.errors import UserError
from neilfpp_method.hosts.base import HasSurfaceWidth, Host
from neilfpp_method.hosts.outputs import check_tensors
from neilfpp_method.structures import RayBatch, SurfaceHits

__all__ = ["HIT_SHARE", "Case", "ContractBroken", "Modes", "render_checked"]

HIT_SHARE = 0.8
"""Least concentration of a hit, as in the presets."""


class ContractBroken(AssertionError):
    """A host breaks the contract; `check` names the check that found it."""

    check = "tensors"


@dataclass(frozen=True)
class Modes:
    """Of the modules that a host is made of, as far as they can be told, and of its parameters."""

    training: tuple[bool, ...]
    moves: tuple[bool, ...]

    @staticmethod
    def of(modules: Sequence[nn.Module], parameters: Sequence[nn.Parameter]) -> Modes:
        """As they are now."""
        parts = [part for module in modules for part in module.modules()]
        return Modes(tuple(part.training for part in parts), tuple(p.requires_grad for p in parameters))

    def restore(self, modules: Sequence[nn.Module], parameters: Sequence[nn.Parameter]) -> None:
        """Make it so again."""
        for part, training in zip(
            (p for module in modules for p in module.modules()), self.training, strict=True
        ):
            part.training = training
        for parameter, moves in zip(parameters, self.moves, strict=True):
            parameter.requires_grad_(moves)


@dataclass(frozen=True)
class Case:
    """A host under test, and what it made of the rays.

    Attributes:
        host: under test.
        name: of the host, for messages.
        before: the modes of the host's modules, and which parameters move, before it was asked for the first
            time.
        now: the same, as it is now.
        rays: what it was asked.
        parameters: what it trains.
        trains_geometry: whether L_phys may move its surface.
        hits: what it answered.
        hit: which rays meet a surface.
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

    def require(self, kept: bool | Tensor, broken: str) -> None:
        """Raise what is broken, unless it is kept."""
        if not kept:
            raise ContractBroken(f"{self.name}: {broken}")

    def seeded(self, rays: RayBatch, seed: int = 0) -> SurfaceHits:
        """What the host renders after a seed; the random state is as before."""
        with torch.random.fork_rng(devices=[rays.origins.device] if rays.origins.is_cuda else []):
            torch.manual_seed(seed)
            return render_checked(self.host, self.name, rays)

    def constants(self, rays: RayBatch, seed: int = 0) -> SurfaceHits:
        """The same without a gradient."""
        with torch.no_grad():
            return self.seeded(rays, seed).detach()

    @property
    def width(self) -> float:
        """How thick the surface is, scene units; 0 for a host that does not say."""
        return float(self.host.surface_width()) if isinstance(self.host, HasSurfaceWidth) else 0.0


def render_checked(host: Host, name: str, rays: RayBatch) -> SurfaceHits:
    """What the host renders, with the shapes and the device of the contract.

    Raises:
        ContractBroken: it has others, or cannot be asked.
    """
    try:
        hits = host.render(rays)
        check_tensors(name, rays, {f.name: getattr(hits, f.name, None) for f in fields(SurfaceHits)})
    except UserError as error:
        raise ContractBroken(str(error)) from error
    return hits
