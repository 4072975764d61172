"""The memory of surface points to which the light is fitted."""

from __future__ import annotations

import torch

from neilfpp_method.lighting.memory import SurfaceMemory
from tests.lighting.surfaces import points


def test_the_first_fit_waits_for_a_full_memory_or_a_few_steps():
    memory = SurfaceMemory(20, every=100)
    memory.remember(points(12))
    assert not memory.due
    memory.remember(points(12, seed=1))
    assert memory.due
    few = SurfaceMemory(20, every=100)
    for step in range(4):
        assert not few.due, step
        few.remember(points(1, seed=step))
    assert few.due
    assert len(few.recall()) == 4


def test_a_fit_is_due_when_the_memory_is_full_and_then_regularly():
    memory = SurfaceMemory(20, every=4)
    assert not memory.due
    memory.remember(points(50))
    assert memory.due
    assert len(memory.recall()) == 20
    for step in range(4):
        assert not memory.due, step
        memory.remember(points(50, seed=step + 2))
    assert memory.due
    kept = memory.recall()
    for step in range(4):  # five points of each of the four steps
        newest = points(50, seed=step + 2).normal[:5]
        assert all((kept.normal == normal).all(-1).any() for normal in newest)


def test_memory_is_restored_from_a_checkpoint():
    memory, again = SurfaceMemory(20, every=4), SurfaceMemory(20, every=4)
    memory.remember(points(12))
    memory.recall()
    memory.remember(points(12, seed=5))
    again.load_state_dict(memory.state_dict())
    assert again.get_extra_state() == memory.get_extra_state()
    for one, other in zip(vars(memory.recall()).values(), vars(again.recall()).values(), strict=True):
        assert torch.equal(one, other)
