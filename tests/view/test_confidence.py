"""Expected errors on a surface: the points that carry them, and values between these points."""

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree

from neilfpp_method.evaluate.confidence import coordinates, deviations_at
from neilfpp_method.relight.cameras import turntable
from neilfpp_method.relight.surface import Surface
from neilfpp_method.structures import OrientedPoints
from neilfpp_method.train.run import load_run
from neilfpp_method.view import confidence
from neilfpp_method.view.confidence import ExpectedErrors, points_on
from neilfpp_method.view.pictures import LARGEST_ERROR, PictureRequest, frames
from neilfpp_method.view.speed import RenderSpeed
from neilfpp_method.view.subject import ERROR_LAYERS, own_light, subject_of


def test_points_are_uniform_by_area():
    box = trimesh.creation.box((2.0, 1.0, 1.0))
    points = points_on(Surface(torch.from_numpy(box.triangles.astype(np.float32))), 20_000)
    # Two of six faces have area 1, four have area 2.
    on_small_faces = (points.normal[:, 0].abs() > 0.99).float().mean().item()
    assert on_small_faces == pytest.approx(0.2, abs=0.01)
    on_face = (points.position.abs() - torch.tensor([1.0, 0.5, 0.5])).abs().amin(-1)
    assert on_face.max() < 1e-6


def test_errors_are_those_of_the_near_points_of_the_same_side():
    """A thin plate whose sides have different errors."""
    side = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    grid = torch.cartesian_prod(torch.linspace(-1, 1, 20), torch.linspace(-1, 1, 20), torch.zeros(1))
    position, normal = grid.repeat(2, 1), side.repeat_interleave(len(grid), 0)
    values = torch.cat((torch.full((len(grid), 3), 0.1), torch.full((len(grid), 3), 0.4)))
    errors = ExpectedErrors(cKDTree(coordinates(position, normal)), values)
    x = torch.rand(50, 3) * torch.tensor([1.8, 1.8, 0.0]) - torch.tensor([0.9, 0.9, 0.0])
    torch.testing.assert_close(errors.at(x, side[:1].expand(50, 3)), torch.full((50, 3), 0.1))
    torch.testing.assert_close(errors.at(x, side[1:].expand(50, 3)), torch.full((50, 3), 0.4))


def test_few_points_are_enough():
    errors = ExpectedErrors(cKDTree(np.zeros((1, 6))), torch.tensor([[0.1, 0.2, 0.3]]))
    torch.testing.assert_close(errors.at(torch.zeros(2, 3), torch.zeros(2, 3))[1], errors.values[0])


def test_the_layers_show_the_expected_errors(found, monkeypatch):
    """They are computed once, when the first of the layers is shown, and mapped to colours."""
    monkeypatch.setattr(confidence, "POINTS", 200)
    subject = subject_of(load_run(found), 32)
    camera = turntable(subject.run.capture, 2, None, 40)[0].camera
    assert not subject.has_expected_errors
    brightest = []
    for layer in ERROR_LAYERS:
        *_, frame = (
            f
            for f in frames(PictureRequest(subject, camera, layer, own_light(subject.run)), RenderSpeed())
            if f
        )
        shown = frame.image[frame.depth < 50].astype(float).sum(-1)
        brightest.append(shown.max())
        assert subject.has_expected_errors
    points = points_on(subject.surface, 200)
    own = deviations_at(subject.run, OrientedPoints(points.position, points.normal))
    torch.testing.assert_close(subject.expected_errors.values, own, atol=0.05, rtol=0.2)
    assert (own.mean(0) > 0).all()
    # Colours become brighter with the error, up to the largest.
    order = np.argsort(own.mean(0).clamp_max(LARGEST_ERROR).numpy())
    assert brightest[order[0]] <= brightest[order[-1]]
