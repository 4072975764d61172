"""The table of groups of true material: which pixels are in which group, and the means over them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from benchmarks.material_groups import Compared, compare, markdown
from neilfpp_method.data.capture import load_capture
from neilfpp_method.errors import UserError
from neilfpp_method.structures import Material
from tests.data.make_capture import METALLIC, ROUGHNESS, make_capture
from tests.evaluate.test_confidence import make_run


def material(rows: list[tuple[float, float, float]]) -> Material:
    """Grey surfaces of given base colour, roughness and metallic."""
    base, roughness, metallic = torch.tensor(rows).split(1, dim=1)
    return Material(base.expand(-1, 3), roughness, metallic)


def test_means_over_groups_by_hand():
    truth = material([(0.1, 0.5, 0.0), (0.8, 0.5, 0.0), (0.6, 0.5, 0.0), (0.9, 0.3, 1.0)])
    estimate = material([(0.2, 0.4, 0.1), (0.7, 0.6, 0.0), (0.5, 0.6, 0.2), (0.9, 0.4, 0.8)])
    hit, shading = torch.tensor([1.0, 2.0, 4.0, 8.0]), torch.tensor([1.0, 1.0, 2.0, 6.0])
    assert list(markdown(Compared(hit, shading, estimate, truth)))[2:] == [
        "| all | 1.000 | 3.8 | 2.5 | 0.57 (0.60) | 0.50 (0.45) | 0.28 (0.25) |",
        "| dark paint | 0.250 | 1.0 | 1.0 | 0.20 (0.10) | 0.40 (0.50) | 0.10 (0.00) |",
        "| light paint | 0.500 | 3.0 | 1.5 | 0.60 (0.70) | 0.60 (0.50) | 0.10 (0.00) |",
        "| smooth metal | 0.250 | 8.0 | 6.0 | 0.90 (0.90) | 0.40 (0.30) | 0.80 (1.00) |",
    ]


def test_the_true_surface_has_no_errors_of_normals(tmp_path):
    """The maps of the truth are stored with 8 bits per channel."""
    found = compare(make_run(load_capture(make_capture(tmp_path, size=(40, 30)))))
    assert len(found.hit_error) > 100
    assert found.hit_error.max() < 0.1
    assert found.shading_error.max() < 0.1
    assert found.estimate.base_color.shape == found.truth.base_color.shape
    assert found.truth.roughness.mean().item() == pytest.approx(ROUGHNESS, abs=0.002)
    assert found.truth.metallic.mean().item() == pytest.approx(METALLIC, abs=0.002)


def test_a_capture_without_true_materials_is_refused(tmp_path):
    capture = load_capture(make_capture(tmp_path))
    bare = replace(capture, test=frozenset({"001"}))  # only the views of the split have true materials
    with pytest.raises(UserError, match="no true normals and materials"):
        compare(make_run(bare))
