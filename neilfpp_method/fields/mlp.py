"""Multilayer perceptrons, and gradients of their outputs with respect to their input.

The gradient is computed by a reverse pass that is written out in differentiable operations. A loss on it
needs one ordinary backward pass, whereas autograd would have to differentiate its own backward pass.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional
from torch.nn.utils import parametrizations

from neilfpp_method.errors import UserError
from neilfpp_method.kernels.softplus import UnitSample, softplus, softplus_and_slope

__all__ = [
    "ACTIVATIONS",
    "Activation",
    "Mlp",
    "MlpSample",
    "geometric_init_",
    "middle_skip",
    "weight_normalize_",
]

SOFTPLUS_SHARPNESS = 100.0
"""Sharpness of softplus units (IDR, VolSDF)."""
SINE_FREQUENCY = 30.0
"""ω of sine units (SIREN)."""
SPHERE_SAMPLES = 4096
"""Points at which the geometric initialisation is corrected."""
RIDGE = 1e-2
"""Ridge penalty of that correction, relative to the mean square of a unit."""
SKIP_FROM = 4
"""Number of hidden layers from which a network gets its input again, at the middle layer (DeepSDF)."""


@dataclass(frozen=True)
class Activation:
    """An activation function, a function of its value and derivative, and the initialisation of its layer."""

    value: Callable[[Tensor], Tensor]
    with_slope: Callable[[Tensor], UnitSample]
    init_: Callable[[nn.Linear], object]


def _he_(layer: nn.Linear) -> None:
    """He et al. 2015: keeps the variance through rectifiers."""
    nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
    nn.init.zeros_(layer.bias)


def _siren_(layer: nn.Linear) -> None:
    """Sitzmann et al. 2020, theorem 1.8: keeps the distribution through sines."""
    bound = math.sqrt(6 / layer.in_features) / SINE_FREQUENCY
    nn.init.uniform_(layer.weight, -bound, bound)


# Named functions and not lambdas, so that networks can be pickled.
def _relu_and_slope(z: Tensor) -> UnitSample:
    return UnitSample(torch.relu(z), (z > 0).to(z.dtype))


def _sine(z: Tensor) -> Tensor:
    return torch.sin(SINE_FREQUENCY * z)


def _sine_and_slope(z: Tensor) -> UnitSample:
    return UnitSample(_sine(z), SINE_FREQUENCY * torch.cos(SINE_FREQUENCY * z))


ACTIVATIONS: Mapping[str, Activation] = {
    "softplus": Activation(
        partial(softplus, sharpness=SOFTPLUS_SHARPNESS),
        partial(softplus_and_slope, sharpness=SOFTPLUS_SHARPNESS),
        _he_,
    ),
    "relu": Activation(torch.relu, _relu_and_slope, _he_),
    "sine": Activation(_sine, _sine_and_slope, _siren_),
}


@dataclass(frozen=True)
class MlpSample:
    """All outputs of a network, and the gradients of K of them with respect to the input."""

    value: Float[Tensor, "N O"]
    gradient: Float[Tensor, "N K I"]


class Mlp(nn.Module):
    """A network of hidden layers and a linear output layer.

    Args:
        inputs: number of inputs.
        outputs: number of outputs.
        layers: number of hidden layers.
        width: units per hidden layer.
        activation: activation of the hidden layers.
        skip: index of the layer that gets the input concatenated to its own; `skip = layers` is the output
            layer. If None, no layer does.
        output_scale: factor on the initial weights of the output layer.

    Raises:
        UserError: the skip lies outside the network.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        layers: int,
        width: int,
        activation: Literal["softplus", "relu", "sine"],
        *,
        skip: int | None = None,
        output_scale: float = 1.0,
    ) -> None:
        super().__init__()
        if layers < 1 or (skip is not None and not 1 <= skip <= layers):
            raise UserError(
                f"an MLP of {layers} layers with its skip at layer {skip}", "choose 1 ≤ skip ≤ layers"
            )
        self.activation = ACTIVATIONS[activation]
        self.skip = skip
        fan_in = [inputs] + [width + (inputs if layer == skip else 0) for layer in range(1, layers + 1)]
        self.layers = nn.ModuleList(
            nn.Linear(n, m) for n, m in zip(fan_in, [width] * layers + [outputs], strict=True)
        )
        for layer in self.layers:
            self.activation.init_(layer)
        with torch.no_grad():
            if activation == "sine":
                # SIREN initialises the first layer in its own way, as inputs fill [−1, 1].
                self.layers[0].weight.uniform_(-1 / inputs, 1 / inputs)
            self.layers[-1].weight.mul_(output_scale)

    def forward(self, x: Float[Tensor, "... I"], outputs: slice = slice(None)) -> Float[Tensor, "... O"]:
        """The selected outputs."""
        last = self.layers[-1]
        return functional.linear(self.hidden(x), last.weight[outputs], last.bias[outputs])

    def hidden(self, x: Float[Tensor, "... I"]) -> Float[Tensor, "... H"]:
        """The input of the output layer."""
        hidden = x
        for number, layer in enumerate(self.layers[:-1]):
            hidden = self.activation.value(layer(self._with_skip(hidden, x, number)))
        return self._with_skip(hidden, x, len(self.layers) - 1)

    def with_gradient(self, x: Float[Tensor, "N I"], outputs: slice) -> MlpSample:
        """All outputs, and the gradients of the selected ones with respect to x.

        With z_l = W_l h_l + b_l and h_{l+1} = a(z_l), the reverse pass is g ← (g ⊙ a'(z_l)) W_l from the last
        layer to the first. At the skip layer the part of g that belongs to the input is split off, and it is
        added at the end.
        """
        # Read once: a normalised weight is recomputed at each access.
        weights = [layer.weight for layer in self.layers]
        hidden, slopes = x, []
        for number, layer in enumerate(self.layers[:-1]):
            units = self.activation.with_slope(
                functional.linear(self._with_skip(hidden, x, number), weights[number], layer.bias)
            )
            slopes.append(units.slope[:, None])
            hidden = units.value
        hidden = self._with_skip(hidden, x, len(slopes))
        value = functional.linear(hidden, weights[-1], self.layers[-1].bias)

        gradient, skipped = weights[-1][outputs], 0.0
        for number in reversed(range(len(slopes))):
            if number + 1 == self.skip:
                gradient, skipped = gradient.split((slopes[number].shape[-1], x.shape[-1]), -1)
            gradient = (gradient * slopes[number]) @ weights[number]
        return MlpSample(value, gradient + skipped)

    def _with_skip(self, hidden: Float[Tensor, "... H"], x: Float[Tensor, "... I"], number: int) -> Tensor:
        return torch.cat((hidden, x.to(hidden.dtype)), -1) if number == self.skip else hidden


@torch.no_grad()
def geometric_init_(mlp: Mlp, radius: float, extent: float, encoded: float) -> None:
    """Initialise a softplus network as the signed distance to a sphere: ≈ ‖x‖ − radius for ‖x‖ ≤ extent.

    The initialisation of SAL (Atzmon & Lipman 2020, theorem 1) is exact for infinite width; with 64 units it
    is off by tens of per cent. So the weights of the first output are then corrected by a ridge regression to
    the exact distance.

    Args:
        mlp: the network; its first three inputs are x.
        radius: radius of the sphere, scene units.
        extent: radius of the scene, scene units.
        encoded: factor on the weights of the other inputs, at the first layer and at the skip layer.
    """
    width = mlp.layers[0].out_features
    for number, layer in enumerate(mlp.layers[:-1]):
        nn.init.normal_(layer.weight, std=math.sqrt(2 / width))
        layer.weight[:, 3 if number == 0 else width :] *= encoded
        nn.init.zeros_(layer.bias)
    row = mlp.layers[-1].weight[0]
    nn.init.zeros_(row)
    nn.init.normal_(row[:width], math.sqrt(math.pi / width), 1e-4)
    nn.init.constant_(mlp.layers[-1].bias[0], -radius)

    points = functional.normalize(torch.randn(SPHERE_SAMPLES, 3)) * extent * torch.rand(SPHERE_SAMPLES, 1)
    units = mlp.hidden(functional.pad(points, (0, mlp.layers[0].in_features - 3)))[:, :width].double()
    missing = points.norm(dim=1).double() - units @ row[:width].double()
    gram = units.T @ units
    ridge = RIDGE * gram.diagonal().mean() * torch.eye(width, dtype=gram.dtype)
    row[:width] += torch.linalg.solve(gram + ridge, units.T @ missing).to(row.dtype)


def weight_normalize_(mlp: Mlp) -> None:
    """Parametrise every weight row by length and direction (Salimans & Kingma 2016)."""
    for layer in mlp.layers:
        parametrizations.weight_norm(layer)


def middle_skip(layers: int) -> int | None:
    """Index of the skip layer of a network with `layers` hidden layers; None for a shallow network."""
    return layers // 2 if layers >= SKIP_FROM else None
