"""Skip optimizer steps that are not finite, in training loops outside of this package.

    guard = StepGuard(warn=print)
    guard.watch(optimizer)
    # In every step, with the losses by name:
    guard.begin_step(total.terms, step)
    loss.backward()
    # Changes no parameter if a loss or gradient is not finite:
    optimizer.step()

The loop of `neilfpp train` has its own implementation (`train.loop`).
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
"""Number of consecutive skipped steps after which the training has diverged."""


class StepGuard:
    """Removes all gradients of a step if one of them, or a loss, is not finite.

    Optimizers do not change a parameter without a gradient. Every such step is counted and reported.

    Args:
        warn: prints a line for the user.

    Attributes:
        skipped: number of steps skipped so far.
    """

    def __init__(self, warn: Callable[[str], None]) -> None:
        self.warn = warn
        self.skipped = 0
        self._in_a_row = 0
        self._step = -1
        self._terms: Mapping[str, Tensor] = {}
        self._optimizers: list[Optimizer] = []
        self._judged, self._is_finite = False, True

    def watch(self, optimizer: Optimizer) -> None:
        """Check the gradients of this and all other watched optimizers before each step of the optimizer."""
        if not any(optimizer is watched for watched in self._optimizers):
            self._optimizers.append(optimizer)
            optimizer.register_step_pre_hook(self._before_step)

    def begin_step(self, terms: Mapping[str, Tensor], step: int) -> None:
        """Announce a training step; it is checked before the next step of a watched optimizer.

        Args:
            terms: the losses by name, scalars.
            step: number of the step.
        """
        self._terms, self._step, self._judged = terms, step, False

    @torch.no_grad()
    def _before_step(self, optimizer: Optimizer, *_: object) -> None:
        """Check a training step once, before the first of its optimizers changes anything.

        Raises:
            Diverged: if ten steps in a row were not finite.
        """
        if not self._judged:
            self._judged, self._is_finite = True, self._judge()
        if not self._is_finite:
            # Only the gradients of this optimizer: a GradScaler reads those of another one before its step.
            optimizer.zero_grad(set_to_none=True)

    def _judge(self) -> bool:
        """Whether the losses and gradients of this step are finite; counts and reports a step that is not."""
        name = self._first_not_finite()
        if name is None:
            self._in_a_row = 0
            return True
        self.skipped += 1
        self._in_a_row += 1
        self.warn(f"step {self._step} skipped: {name} is not finite ({self.skipped} skipped so far)")
        if self._in_a_row >= MAX_SKIPPED_IN_A_ROW:
            raise Diverged(
                f"{MAX_SKIPPED_IN_A_ROW} steps in a row were not finite, the last one in {name}",
                "go back to the last good checkpoint; look at the brightest pixels or lower the learning "
                "rates",
            )
        return False

    def _first_not_finite(self) -> str | None:
        """The name of a loss or gradient that is not finite, or None; needs one transfer from the device."""
        groups = [group for optimizer in self._optimizers for group in optimizer.param_groups]
        norms = {}
        for i, group in enumerate(groups):
            gradients = [p.grad for p in group["params"] if p.grad is not None]
            if gradients:
                name = group.get("name", f"group {i}")
                norms[name] = torch.stack([g.norm() for g in gradients]).norm()
        terms = {f"loss {name}": value.detach() for name, value in self._terms.items()}
        terms |= {f"the gradient of {name}": norm for name, norm in norms.items()}
        if not terms:
            return None
        values = torch.stack([value.to(torch.float32) for value in terms.values()]).tolist()
        return next(
            (name for name, value in zip(terms, values, strict=True) if not math.isfinite(value)), None
        )
