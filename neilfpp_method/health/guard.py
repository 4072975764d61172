"""Leaves out steps that are not finite, in loops whose optimisers are somebody else's.

    guard = StepGuard(warn=print)
    guard.watch(optimizer)
    guard.begin_step(total.terms, step)   # in every step, with the losses by name
    loss.backward()
    optimizer.step()                      # moves nothing where a loss or a gradient is not finite

The loop of `neilfpp train` does the same by itself (`train.loop`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import torch
from torch import Tensor
from torch.optim import Optimizer

from neilfpp_method.errors import Diverged

__all__ = ["MAX_SKIPPED_IN_A_ROW", "StepGuard"]

MAX_SKIPPED_IN_A_ROW = 10
"""So many steps in a row without a finite loss and gradient are no accident."""


class StepGuard:
    """Drops all gradients of a step where one of them, or a loss, is not finite: optimisers move nothing that
    has no gradient. Every such step is counted and named.

    Args:
        warn: says a line to the person.

    Attributes:
        skipped: steps that were left out so far.
    """

    def __init__(self, warn: Callable[[str], None]) -> None:
        self.warn = warn
        self.skipped = 0
        self._in_a_row = 0
        self._step = -1
        self._terms: Mapping[str, Tensor] = {}
        self._optimizers: list[Optimizer] = []
        self._judged = False

    def watch(self, optimizer: Optimizer) -> None:
        """Judge the gradients of an optimiser before each of its steps, together with those of the others
        that are watched.
        """
        if not any(optimizer is known for known in self._optimizers):
            self._optimizers.append(optimizer)
            optimizer.register_step_pre_hook(self._before_step)

    def begin_step(self, terms: Mapping[str, Tensor], step: int) -> None:
        """A step begins: its losses by name, scalars, and its number. The next step of an optimiser judges
        it.
        """
        self._terms, self._step, self._judged = terms, step, False

    @torch.no_grad()
    def _before_step(self, *_: object) -> None:
        """Judge a step once, before the first of its optimisers moves anything.

        Raises:
            Diverged: ten steps in a row were not finite.
        """
        if self._judged:
            return
        self._judged = True
        culprit = self._culprit()
        if culprit is None:
            self._in_a_row = 0
            return
        for optimizer in self._optimizers:
            optimizer.zero_grad(set_to_none=True)
        self.skipped += 1
        self._in_a_row += 1
        self.warn(f"step {self._step} skipped: {culprit} is not finite ({self.skipped} skipped so far)")
        if self._in_a_row >= MAX_SKIPPED_IN_A_ROW:
            raise Diverged(
                f"{MAX_SKIPPED_IN_A_ROW} steps in a row were not finite, the last one in {culprit}",
                "go back to the last good checkpoint; look at the brightest pixels or lower the learning "
                "rates",
            )

    def _culprit(self) -> str | None:
        """What is not finite; none: all is. One transfer from the device where all is."""
        groups = [group for optimizer in self._optimizers for group in optimizer.param_groups]
        norms = {}
        for i, group in enumerate(groups):
            gradients = [p.grad for p in group["params"] if p.grad is not None]
            if gradients:
                name = group.get("name", f"group {i}")
                norms[name] = torch.stack([g.norm() for g in gradients]).norm()
        known = {f"loss {name}": value.detach() for name, value in self._terms.items()}
        known |= {f"the gradient of {name}": norm for name, norm in norms.items()}
        if not known:
            return None
        values = torch.stack([value.to(torch.float32) for value in known.values()]).tolist()
        return next(
            (name for name, value in zip(known, values, strict=True) if not math.isfinite(value)), None
        )
