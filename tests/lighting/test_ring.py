"""The ring buffer of rows."""

from __future__ import annotations

import torch

from neilfpp_method.lighting.ring import Ring


def rows(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float32)[:, None].expand(-1, 2)


def held(ring: Ring) -> list[float]:
    return sorted(ring.kept()[:, 0].tolist())


def test_new_rows_replace_the_oldest():
    ring = Ring(4, 2)
    ring.keep(rows(1, 2, 3))
    assert held(ring) == [1, 2, 3]
    assert not ring.full
    ring.keep(rows(4, 5))
    assert held(ring) == [2, 3, 4, 5]
    assert ring.full
    ring.keep(rows(6, 7, 8, 9, 10))
    assert held(ring) == [6, 7, 8, 9], "more than fit: the first"


def test_draws_return_stored_rows():
    torch.manual_seed(0)
    ring = Ring(100, 2)
    assert len(ring.draw(5)) == 0
    ring.keep(rows(*range(40)))
    assert len(ring.draw(50)) == 40
    drawn = torch.cat([ring.draw(40) for _ in range(50)])[:, 0]
    counts = drawn.long().bincount(minlength=100)
    assert counts[40:].sum() == 0
    # 2000 draws of 40 rows, 50 each: chi-square of 39 degrees of freedom, 1 in a thousand above 72.
    assert (counts[:40] - 50).square().sum() / 50 < 72


def test_a_ring_is_restored_from_a_checkpoint():
    ring, again = Ring(4, 2), Ring(4, 2)
    ring.keep(rows(1, 2, 3, 4))
    ring.keep(rows(5))
    again.load_state_dict(ring.state_dict())
    for each in (ring, again):
        each.keep(rows(6))
    assert held(again) == held(ring) == [3, 4, 5, 6]
