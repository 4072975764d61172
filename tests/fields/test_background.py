"""The inverted sphere: its coordinates and its compositing."""

from __future__ import annotations

import pytest
import torch

from neilfpp_method.fields.background import InvertedSphere
from neilfpp_method.settings.types import BackgroundConfig, FrequencyConfig, HashGridConfig

WAVES, GRID = FrequencyConfig(), HashGridConfig(levels=4, log2_entries=10, max_resolution=32)
CONFIG, SMALL = BackgroundConfig(radius=3.0, samples=8), BackgroundConfig(radius=2.0, samples=8)


def rays(radius: float, count: int = 20) -> tuple[torch.Tensor, torch.Tensor]:
    """Rays with origins everywhere within the sphere."""
    generator = torch.Generator().manual_seed(1)
    outwards, directions = torch.nn.functional.normalize(
        torch.randn(2, count, 3, generator=generator).double(), dim=-1
    )
    origins = 0.99 * radius * outwards * torch.rand(count, 1, generator=generator)
    return origins, directions


@pytest.mark.parametrize("encoding", [WAVES, GRID])
@pytest.mark.parametrize("density", [-50.0, 0.0, 3.0, 50.0])
def test_a_constant_color_does_not_depend_on_the_density(density, encoding):
    torch.manual_seed(0)
    field = InvertedSphere(CONFIG, encoding, scale=2.0)
    with torch.no_grad():
        field.trunk.layers[-1].bias[0] = density
        field.head.layers[-1].weight.zero_()
        field.head.layers[-1].bias.copy_(torch.logit(torch.tensor([0.1, 0.2, 0.9])))
    color = field(*(t.float() for t in rays(3.0)))
    torch.testing.assert_close(color, torch.tensor([0.2, 0.4, 1.8]).expand(20, 3))


def test_samples_lie_on_the_rays_in_equal_steps_of_inverse_radius():
    field = InvertedSphere(SMALL, WAVES, scale=1.0).double()
    seen = []
    field.position.register_forward_hook(lambda _, given, __: seen.append(given[0]))
    origins, directions = rays(2.0)
    field(origins, directions)
    unit, inverse = seen[0].split((3, 1), -1)
    torch.testing.assert_close(unit.norm(dim=-1), torch.ones_like(unit[..., 0]))
    expected = torch.tensor([(1 - (k + 0.5) / 8) / 2 for k in range(8)], dtype=torch.float64)
    torch.testing.assert_close(inverse[..., 0], expected.expand(20, 8))
    traveled = unit / inverse - origins[:, None]
    along = (traveled * directions[:, None]).sum(-1, keepdim=True)
    assert along.min() > 0
    torch.testing.assert_close(traveled, along * directions[:, None])


def test_a_hash_grid_encodes_the_contraction_of_the_same_points():
    waves, grid = (InvertedSphere(SMALL, encoding, scale=1.0) for encoding in (WAVES, GRID))
    charts, contracted = [], []
    waves.position.register_forward_hook(lambda _, given, __: charts.append(given[0]))
    grid.position.register_forward_hook(lambda _, given, __: contracted.append(given[0]))
    origins, directions = (t.float() for t in rays(2.0))
    waves(origins, directions), grid(origins, directions)
    unit, inverse = charts[0].split((3, 1), -1)
    points = unit / inverse
    distance = points.norm(dim=-1, keepdim=True) / 2.0  # in radii of the scene sphere
    # Barron et al. 2022, eq. 10
    expected = (2 - 1 / distance) * unit
    torch.testing.assert_close(contracted[0].view(20, 8, 3), expected)
    assert contracted[0].norm(dim=-1).min() > 1.0
    assert contracted[0].norm(dim=-1).max() < 2.0


@pytest.mark.parametrize(("encoding", "layers", "width"), [(WAVES, 8, 256), (GRID, 2, 64)])
def test_the_network_has_the_published_size(encoding, layers, width):
    trunk = InvertedSphere(SMALL, encoding, scale=1.0).trunk
    assert [layer.out_features for layer in trunk.layers] == [width] * layers + [1 + width]


@pytest.mark.parametrize("start", [(0.25, 0.2, 0.15), (1.0, 0.5, 0.04)])
def test_the_field_starts_with_the_given_color(start):
    torch.manual_seed(0)
    field = InvertedSphere(CONFIG, WAVES, scale=2.0, start=torch.tensor(start))
    color = field(*(t.float() for t in rays(3.0)))
    torch.testing.assert_close(color, torch.tensor(start).expand(20, 3), rtol=0.02, atol=1e-3)


@pytest.mark.parametrize("start", [0.0, 2.0, 5.0])
def test_a_color_out_of_range_does_not_stop_training(start):
    field = InvertedSphere(CONFIG, WAVES, scale=2.0, start=torch.full((3,), start))
    color = field(*(t.float() for t in rays(3.0)))
    color.sum().backward()
    assert ((color > 0.01) & (color < 1.99)).all()
    assert (field.head.layers[-1].bias.grad.abs() > 1e-3).all()


def test_two_samples_by_hand():
    """With an optical depth of ln 2 over the whole range, half of the light passes all of it, and √½ passes
    each half.
    """
    torch.manual_seed(0)
    field = InvertedSphere(BackgroundConfig(radius=4.0, samples=2), WAVES, scale=1.0)
    with torch.no_grad():
        field.trunk.layers[-1].weight[0].zero_()
        field.trunk.layers[-1].bias[0] = 0  # softplus(0) = ln 2
        field.head.layers[-1].weight.normal_()
    colors = []
    field.head.register_forward_hook(lambda _, __, out: colors.append(torch.sigmoid(out)))
    got = field(*(t.float() for t in rays(4.0)))
    near, far = colors[0].unbind(1)
    # samples at 1/4 and 3/4 of the chart: the near one covers half of it, exp(−ln 2 / 2) = 0.7071 passes; the
    # far one covers the rest, and what passes it has its colour too
    torch.testing.assert_close(got, (1 - 0.5**0.5) * near + 0.5**0.5 * far)
