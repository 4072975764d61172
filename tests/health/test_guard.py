"""Steps that are not finite, in a training loop outside of the package."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from neilfpp_method.errors import Diverged
from neilfpp_method.health.guard import MAX_SKIPPED_IN_A_ROW, StepGuard


def two_fields() -> tuple[nn.Parameter, nn.Parameter, list[torch.optim.Optimizer]]:
    one, other = nn.Parameter(torch.ones(2)), nn.Parameter(torch.ones(2))
    optimizers = [
        torch.optim.Adam([{"params": [one], "name": "brdf"}], lr=0.1),
        torch.optim.Adam([{"params": [other], "name": "light"}], lr=0.1),
    ]
    return one, other, optimizers


def step(guard: StepGuard, optimizers, loss: torch.Tensor, number: int = 0) -> None:
    guard.begin_step({"physical": loss}, number)
    for optimizer in optimizers:
        optimizer.zero_grad()
    loss.backward()
    for optimizer in optimizers:
        optimizer.step()


def guarded(optimizers) -> tuple[StepGuard, list[str]]:
    said: list[str] = []
    guard = StepGuard(said.append)
    for optimizer in optimizers:
        guard.watch(optimizer)
    return guard, said


def test_a_gradient_that_is_not_finite_changes_no_field_in_any_order():
    one, other, optimizers = two_fields()
    guard, said = guarded(optimizers)
    # The value is finite; the slope of a square root at 0 is not.
    step(guard, optimizers, one.sum() + (other - other.detach()).clamp_min(0).sqrt().sum(), 7)
    assert torch.equal(one, torch.ones(2))
    assert torch.equal(other, torch.ones(2))
    assert said == ["step 7 skipped: the gradient of light is not finite (1 skipped so far)"]
    step(guard, optimizers, one.sum() + other.sum(), 8)
    assert not torch.equal(one, torch.ones(2))
    assert not torch.equal(other, torch.ones(2))
    assert len(said) == guard.skipped == 1


def test_a_loss_that_is_not_finite_is_named():
    one, _, optimizers = two_fields()
    guard, said = guarded(optimizers)
    step(guard, optimizers, one.sum() * torch.inf)
    assert torch.equal(one, torch.ones(2))
    assert "loss physical" in said[0]


def test_a_skipped_step_does_not_change_the_optimizer_state():
    one, _, optimizers = two_fields()
    guard, _ = guarded(optimizers)
    step(guard, optimizers, one.sum() * torch.nan)
    step(guard, optimizers, one.sum())
    clean, _, others = two_fields()
    step(StepGuard(print), others, clean.sum())
    assert torch.equal(one, clean)


def test_ten_in_a_row_end_the_training_and_nine_do_not():
    one, _, optimizers = two_fields()
    guard, _ = guarded(optimizers)
    for _ in range(MAX_SKIPPED_IN_A_ROW - 1):
        step(guard, optimizers, one.sum() * torch.nan)
    step(guard, optimizers, one.sum())
    for _ in range(MAX_SKIPPED_IN_A_ROW - 1):
        step(guard, optimizers, one.sum() * torch.nan)
    with pytest.raises(Diverged, match="loss physical"):
        step(guard, optimizers, one.sum() * torch.nan)


def test_an_optimizer_watched_twice_is_checked_once():
    one, _, optimizers = two_fields()
    guard, said = guarded([*optimizers, *optimizers])
    step(guard, optimizers, one.sum() * torch.nan)
    assert len(said) == 1


@pytest.mark.parametrize("first", [0, 1])
def test_a_gradient_scaler_finds_the_gradients_that_it_checks(first: int):
    """The gradient of one of two optimizers is too large for two steps."""
    one, other, optimizers = two_fields()
    guard, said = guarded(optimizers)
    scaler = torch.amp.GradScaler("cpu", init_scale=2.0**16)
    for number, factor in enumerate((torch.inf, torch.inf, 4.0)):
        loss = one.sum() + factor * other.sum()
        guard.begin_step({}, number)
        for optimizer in optimizers:
            optimizer.zero_grad()
        scaler.scale(loss).backward()
        for optimizer in (optimizers[first], optimizers[1 - first]):
            scaler.step(optimizer)
        scaler.update()
        assert [not torch.equal(field, torch.ones(2)) for field in (one, other)] == [number == 2] * 2
    assert scaler.get_scale() == 2.0**14
    assert len(said) == guard.skipped == 2
