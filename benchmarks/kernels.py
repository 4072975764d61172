"""Cost of the signed distance, its normal and their backward pass with a hash grid, by three implementations.

    python -m benchmarks.kernels [--points 32768] [--repeats 9] [--device cpu]

- naive: straightforward torch; the normal is autograd's gradient of the distance, which the loss
  differentiates once more.
- reference: the analytic Jacobian and the explicit reverse pass of the package, in torch.
- fastest: the same with the compiled loops (CPU) or Triton's kernels (CUDA).

All three compute the same loss of the same field, and their gradients are compared before the timing. The
implementations alternate, so that other work on the machine affects all of them equally. Medians and their
ratios are printed.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
import tyro
from jaxtyping import Float
from torch import Tensor

from benchmarks.measure import hardware, median_seconds
from benchmarks.straightforward import plain_units
from neilfpp_method.fields.sdf import SdfField
from neilfpp_method.kernels import GridSpec, encode
from neilfpp_method.settings.presets import preset
from neilfpp_method.settings.types import HashGridConfig, SdfConfig

RADIUS = 1.75
PRIMES = (1, 2654435761, 805459861)
SAMPLES = 32  # points of one ray: neighbours in memory are neighbours in space, as in training


def naive_encode(
    x01: Float[Tensor, "N 3"], table: Float[Tensor, "T F"], spec: GridSpec
) -> Float[Tensor, "N F"]:
    """A hash grid in straightforward torch: eight weighted rows per level."""
    features = []
    for level, resolution in enumerate(spec.resolutions):
        scaled = x01.clamp(0, 1) * resolution
        cell = scaled.detach().long().clamp(0, resolution - 1)
        fraction = scaled - cell
        total = torch.zeros(len(x01), spec.features, device=x01.device)
        for corner in itertools.product((0, 1), repeat=3):
            offset = torch.tensor(corner, device=x01.device)
            i, j, k = (cell + offset).unbind(1)
            if spec.is_dense(level):
                row = i + (resolution + 1) * (j + (resolution + 1) * k)
            else:
                row = ((i * PRIMES[0]) ^ (j * PRIMES[1]) ^ (k * PRIMES[2])) % spec.entries_per_level[level]
            x, y, z = torch.where(offset.bool(), fraction, 1 - fraction).unbind(1)
            total = total + (x * y * z)[:, None] * table[spec.offsets[level] + row]
        features.append(total)
    return torch.cat(features, 1)


def naive_step(field: SdfField, x: Float[Tensor, "N 3"]) -> None:
    """Distance, normal by autograd, and the gradient of a loss on both."""
    grid = field.encoding
    x = x.detach().requires_grad_()
    features = naive_encode(x / (2 * RADIUS) + 0.5, grid.table, grid.spec)
    distance = plain_units(field.mlp)(torch.cat((x, features), 1))[:, 0]
    (gradient,) = torch.autograd.grad(distance.sum(), x, create_graph=True)
    loss_on(distance, gradient).backward()


def analytic_step(field: SdfField, x: Float[Tensor, "N 3"]) -> None:
    """The same with the analytic derivatives of the package."""
    sample = field.with_gradient(x)
    loss_on(sample.distance, sample.gradient).backward()


def loss_on(distance: Float[Tensor, " N"], gradient: Float[Tensor, "N 3"]) -> Float[Tensor, ""]:
    return (gradient.norm(dim=1) - 1).square().mean() + distance.square().mean()


def encode_alone(field: SdfField, x: Float[Tensor, "N 3"]) -> None:
    """The hash grid only: features, Jacobian, and the gradient of the table."""
    grid = field.encoding
    encoded = encode(x / (2 * RADIUS) + 0.5, grid.table, grid.spec, jacobian=True)
    torch.autograd.backward((encoded.features, encoded.jacobian), (encoded.features, encoded.jacobian))


def with_backend(
    step: Callable[[SdfField, Tensor], None], backend: str
) -> Callable[[SdfField, Tensor], None]:
    """A step whose grid is computed by a given backend."""

    def chosen(field: SdfField, x: Float[Tensor, "N 3"]) -> None:
        field.encoding.spec = dataclasses.replace(field.encoding.spec, backend=backend)
        step(field, x)

    return chosen


def measure(
    config: SdfConfig, grid: HashGridConfig, points: int, repeats: int, device: torch.device
) -> dict[str, float]:
    """Median milliseconds of each route."""
    torch.manual_seed(0)
    field = SdfField(config, grid, RADIUS).to(device)
    torch.nn.init.normal_(field.encoding.table, std=1e-2)
    start = torch.nn.functional.normalize(torch.randn(points // SAMPLES, 1, 3, device=device), dim=-1)
    along = torch.linspace(0.1, 1.5, SAMPLES, device=device)[:, None]
    x = (start * along + 0.1 * torch.rand(points // SAMPLES, 1, 3, device=device)).reshape(-1, 3)
    routes: dict[str, Callable[[SdfField, Tensor], None]] = {
        "naive": naive_step,
        "reference": with_backend(analytic_step, "reference"),
        "fastest": with_backend(analytic_step, "auto"),
        "reference, grid alone": with_backend(encode_alone, "reference"),
        "fastest, grid alone": with_backend(encode_alone, "auto"),
    }
    gradients = []
    for name in ("naive", "reference", "fastest"):
        field.zero_grad()
        routes[name](field, x)
        gradients.append(field.encoding.table.grad.clone())
    for gradient in gradients[1:]:
        torch.testing.assert_close(
            gradient, gradients[0], rtol=1e-2, atol=1e-4 * gradients[0].abs().max().item()
        )
    calls = [partial(_fresh, route, field, x) for route in routes.values()]
    taken = median_seconds(*calls, repetitions=repeats, where=device)
    return {name: 1e3 * seconds for name, seconds in zip(routes, taken, strict=True)}


def _fresh(route: Callable[[SdfField, Tensor], None], field: SdfField, x: Float[Tensor, "N 3"]) -> None:
    """A step that starts without gradients, as in a training."""
    field.zero_grad()
    route(field, x)


@dataclass
class Options:
    """Time the three implementations."""

    points: int = 32_768
    """Number of points per step."""
    repeats: int = 9
    """Number of timed steps."""
    device: str = "cpu"
    """Device to compute on."""


def main(options: Options) -> None:
    """Measure and print."""
    print(f"{hardware()}; {options.points} points, medians of {options.repeats}")
    for title, name in (("16 levels × 2, 2^19", "paper-ngp"), ("the grid of `fast`, 8 × 2, 2^18", "fast")):
        config = preset(name)
        medians = measure(
            config.host.sdf, config.encoding, options.points, options.repeats, torch.device(options.device)
        )
        print(title)
        for name, median in medians.items():
            print(f"  {name:24} {median:9.1f} ms   {medians['naive'] / median:6.1f} times faster than naive")


if __name__ == "__main__":
    main(tyro.cli(Options))
