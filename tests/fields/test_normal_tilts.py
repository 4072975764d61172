"""The field of tilts: its interpolation, its gradients, and the normals of the model that has one."""

import pytest
import torch
from torch.nn.functional import normalize

from neilfpp_method.fields.normal_tilts import MAX_GRADIENT, UNIT, VERTICES, NormalTilts, tilted
from neilfpp_method.schedule import Stage
from neilfpp_method.settings.plain import changed
from tests.scenes import sphere_batch, sphere_model, tiny_config


def filled(tilts: NormalTilts) -> NormalTilts:
    """Grid values that are a linear function of position, so that interpolation is exact."""
    axis = torch.linspace(-1.0, 1.0, VERTICES, dtype=tilts.grid.dtype)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    with torch.no_grad():
        tilts.grid.copy_(torch.stack((x, 2 * y, 3 * z))[None])
    return tilts


def test_a_linear_function_is_interpolated_exactly():
    x = torch.rand(50, 3) * 2 - 1
    torch.testing.assert_close(filled(NormalTilts())(x).detach(), UNIT * x * torch.tensor([1.0, 2.0, 3.0]))


def test_there_is_no_tilt_outside_the_object_and_at_first():
    outside = torch.tensor([[1.2, 0.0, 0.0], [0.0, -3.0, 0.0], [0.0, 0.0, 1e4]])
    assert not filled(NormalTilts())(outside).any()
    assert not NormalTilts()(torch.rand(20, 3)).any()
    assert NormalTilts()(torch.zeros(0, 3)).shape == (0, 3)


def test_the_tangential_part_turns_the_normal_by_the_arc_tangent_of_its_length():
    up = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    turned = tilted(up, torch.tensor([[0.1, 0.0, 0.7]], dtype=torch.float64))
    torch.testing.assert_close(turned.norm(dim=-1), torch.ones(1, dtype=torch.float64))
    torch.testing.assert_close(turned[0, 0] / turned[0, 2], torch.tensor(0.1, dtype=torch.float64))
    assert torch.equal(tilted(up, 5.0 * up), up)


def test_derivatives():
    normal = normalize(torch.randn(6, 3, dtype=torch.float64), dim=-1).requires_grad_()
    tilt = (0.2 * torch.randn(6, 3, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(tilted, (normal, tilt))
    tilts, x = filled(NormalTilts().double()), torch.rand(1, 3, dtype=torch.float64) * 2 - 1
    # The gradient of a single point is at the median, so it is not limited.
    (gradient,) = torch.autograd.grad(tilts(x)[0, 0], tilts.grid)
    torch.testing.assert_close(gradient.sum(), torch.tensor(UNIT, dtype=torch.float64))
    assert (gradient != 0).sum() == 8


def test_a_point_with_a_huge_gradient_does_not_determine_the_step():
    tilts = NormalTilts()
    x = torch.tensor([[-0.9, 0.0, 0.0], [-0.3, 0.0, 0.0], [0.9, 0.0, 0.0]])
    weight = torch.tensor([1.0, 1.0, 1e6])
    (gradient,) = torch.autograd.grad((weight * tilts(x)[:, 0]).sum(), tilts.grid)
    right = gradient[..., VERTICES // 2 :].sum()
    torch.testing.assert_close(right, torch.tensor(MAX_GRADIENT * UNIT))


def test_the_tilts_are_trained_with_the_material_and_only_then():
    model = sphere_model()
    assert any(p is model.tilts.grid for p in model.parameter_groups()["brdf"])
    for stage in Stage:
        model.freeze_for(stage)
        terms = model.losses(sphere_batch(), stage)
        assert ("tilt" in terms) == (stage is not Stage.SDF_INIT)
        sum(term.mean() for term in terms.values()).backward()
        gradient = model.tilts.grid.grad
        assert (gradient is not None and gradient.abs().max() > 0) == (stage is not Stage.SDF_INIT)


def test_a_model_that_shades_with_the_normals_of_its_host_has_no_tilts():
    model = sphere_model(changed(tiny_config(), {"shading.normals": "host"}))
    assert model.tilts is None
    hits = model.host.render(sphere_batch().rays).detach()
    assert model.shading_normals(hits.position, hits.normal) is hits.normal
    assert "tilt" not in model.losses(sphere_batch(), Stage.MATERIAL_INIT)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_half_precision(dtype):
    tilts = filled(NormalTilts())
    with torch.autocast("cpu", dtype=dtype):
        tilt = tilts(torch.rand(10, 3).to(dtype))
    assert tilt.isfinite().all()
    assert tilt.abs().max() <= 3.1 * UNIT
