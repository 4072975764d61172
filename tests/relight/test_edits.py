"""Edits of the material: parsing, and the region in which they apply."""

from __future__ import annotations

import pytest
import torch

from neilfpp_method.data.views import Normalization
from neilfpp_method.errors import UserError
from neilfpp_method.relight.edits import parse_edits, scene_box, with_edits
from neilfpp_method.structures import Material


def gray(x: torch.Tensor) -> Material:
    return Material(torch.full_like(x, 0.5), torch.full_like(x[:, :1], 0.6), torch.full_like(x[:, :1], 0.1))


def test_edits_replace_what_they_name():
    changed = with_edits(gray, parse_edits(["roughness=0.2", "base_color=0.1,0.2,0.3", "roughness = 0.4"]))(
        torch.rand(4, 3)
    )
    assert torch.allclose(changed.roughness, torch.tensor(0.4))
    assert torch.allclose(changed.base_color, torch.tensor([0.1, 0.2, 0.3]))
    assert torch.allclose(changed.metallic, torch.tensor(0.1))
    assert torch.allclose(
        with_edits(gray, parse_edits(["base_color=1"]))(torch.rand(2, 3)).base_color, torch.tensor(1.0)
    )


def test_a_box_of_the_world_bounds_an_edit():
    # The world is twice as large as the scene, with its centre at (1, 0, 0).
    box = scene_box((3.0, 2.0, 2.0, 1.0, -2.0, -2.0), Normalization(2.0, (1.0, 0.0, 0.0)))
    x = torch.tensor([[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0], [0.5, 0.0, 1.1], [1.0, 1.0, -1.0]])
    changed = with_edits(gray, parse_edits(["metallic=1"]), [box.contains])(x).metallic[:, 0]
    assert changed.numpy() == pytest.approx([1.0, 0.1, 0.1, 1.0])


@pytest.mark.parametrize(
    "text",
    [
        "gloss=1",
        "roughness",
        "roughness=",
        "roughness=2",
        "metallic=nan",
        "roughness=0.1,0.2,0.3",
        "base_color=0.1,0.2",
        "roughness=much",
    ],
)
def test_invalid_edits_are_refused(text):
    with pytest.raises(UserError, match=f"--set {text}"):
        parse_edits([text])


@pytest.mark.parametrize("corners", [(0.0, 0.0, 0.0, 1.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0, 1.0, float("nan"))])
def test_a_box_without_an_inside_is_refused(corners):
    with pytest.raises(UserError, match="--box"):
        scene_box(corners, Normalization(1.0, (0.0, 0.0, 0.0)))
