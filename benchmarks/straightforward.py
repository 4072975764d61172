"""A plain implementation of the method in torch, written directly from the paper: the reference for whole
steps.

The networks, their weights, the losses and the order of a step are those of the package, and the results are
the same. The computation differs:

- softplus units by torch;
- normals, Hessians and gradients of the material by autograd, which a loss on them differentiates once more;
- every ray in every round of VolSDF's Algorithm 1 until all rays of the batch have converged, without
  skipping of empty space;
- every traced ray of L_ref is rendered, whether or not it can hit anything;
- every pair of a point and a direction passes through the whole network of the light.
"""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from neilfpp_method.fields.brdf import BrdfField, BrdfSample
from neilfpp_method.fields.incident_light import IncidentLightField
from neilfpp_method.fields.mlp import SOFTPLUS_SHARPNESS, Mlp
from neilfpp_method.fields.sdf import SdfField, SdfSample
from neilfpp_method.hosts.volsdf import VolSdfHost
from neilfpp_method.model import NeilfModel
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.structures import Material, RayBatch
from neilfpp_method.volume.intersect import Interval
from neilfpp_method.volume.partition import SampleCounts, first_cuts, with_cuts
from neilfpp_method.volume.samplers import (
    OPACITY_ERROR,
    bound_shares,
    bounded_beta,
    log_error_bound,
    opacity_samples,
)

__all__ = ["plain_units", "straightforward"]


def gradient_of(
    output: Float[Tensor, " N"], x: Float[Tensor, "N 3"], differentiable: bool
) -> Float[Tensor, "N 3"]:
    """∂output/∂x, which autograd may differentiate again."""
    return torch.autograd.grad(output.sum(), x, create_graph=differentiable, retain_graph=True)[0]


def plain_units(mlp: Mlp) -> Mlp:
    """The same weights, with torch's softplus."""
    plain = copy.copy(mlp)
    plain.activation = replace(mlp.activation, value=partial(functional.softplus, beta=SOFTPLUS_SHARPNESS))
    return plain


class PlainSdf(nn.Module):
    """G, with ∇G and H G by autograd."""

    def __init__(self, field: SdfField) -> None:
        super().__init__()
        self.encoding, self.mlp = field.encoding, plain_units(field.mlp)

    def forward(self, x: Float[Tensor, "N 3"]) -> Float[Tensor, " N"]:
        return self.mlp(self.encoding(x))[:, 0]

    def with_gradient(self, x: Float[Tensor, "N 3"]) -> SdfSample:
        trains = torch.is_grad_enabled()
        with torch.enable_grad():
            x = x if x.requires_grad else x.detach().requires_grad_()
            outputs = self.mlp(self.encoding(x))
            sample = SdfSample(outputs[:, 0], gradient_of(outputs[:, 0], x, trains), outputs[:, 1:])
        return (
            sample
            if trains
            else SdfSample(sample.distance.detach(), sample.gradient, sample.feature.detach())
        )

    def hessian(self, x: Float[Tensor, "N 3"], method: str | None = None) -> Float[Tensor, "N 3 3"]:
        x = x.detach().requires_grad_()
        gradient = self.with_gradient(x).gradient
        return torch.stack([gradient_of(gradient[:, axis], x, differentiable=True) for axis in range(3)], 1)


class PlainBrdf(nn.Module):
    """B, with the gradients of roughness and metallic by autograd."""

    def __init__(self, field: BrdfField) -> None:
        super().__init__()
        self.field = field

    def forward(self, x: Float[Tensor, "N 3"]) -> Material:
        return self.field(x)

    def with_gradients(self, x: Float[Tensor, "N 3"]) -> BrdfSample:
        x = x if x.requires_grad else x.detach().requires_grad_()
        material = self.field(x)
        roughness, metallic = (
            gradient_of(value[:, 0], x, True) for value in (material.roughness, material.metallic)
        )
        return BrdfSample(material, roughness, metallic)


class PlainLight(nn.Module):
    """L, evaluated for every pair of a point and a direction separately."""

    def __init__(self, field: IncidentLightField) -> None:
        super().__init__()
        self.field = field

    def radiance(self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"]) -> Float[Tensor, "N S 3"]:
        points = x[:, None].expand_as(wi).reshape(-1, 3)
        return self.field.radiance(points, wi.reshape(-1, 1, 3)).view(wi.shape)

    def technique(self, normal: Float[Tensor, "N 3"]) -> None:
        """None: a network cannot be sampled."""
        return None


class PlainHost(VolSdfHost):
    """VolSDF with its sampler as published: all rays of a batch take another round as long as one of them
    needs it.
    """

    def __init__(self, config: NeilfConfig, facts: SceneFacts) -> None:
        super().__init__(config, facts)
        self.sdf_field = PlainSdf(self.sdf_field)

    @torch.no_grad()
    def _sample(self, rays: RayBatch, interval: Interval, counts: SampleCounts) -> Float[Tensor, "N M"]:
        beta = self.density.beta().reshape(1, 1)
        partition = first_cuts(self.sdf, rays, interval, counts.cuts, self.training)
        worst = partition.width.square().sum(dim=-1, keepdim=True).div(4.0 * math.log1p(OPACITY_ERROR)).sqrt()
        wide = torch.maximum(worst, beta)
        for number in range(counts.rounds + 1):
            converged = log_error_bound(partition, beta) <= math.log(OPACITY_ERROR)
            wide = torch.where(converged, beta, bounded_beta(partition, beta, wide))
            if number == counts.rounds or converged.all():
                break
            shares = bound_shares(partition, wide)
            partition = with_cuts(self.sdf, rays, partition, shares, counts.cuts, self.training)
        return opacity_samples(partition, wide, counts, self.training)


def straightforward(model: NeilfModel) -> NeilfModel:
    """A model with the weights of another, whose host is VolSDF and whose light is the paper's, with the
    plain implementation.
    """
    config = changed(model.config, {"host.volume.skip_empty": False, "shading.sampler": "fibonacci"})
    host = PlainHost(config, model.facts)
    plain = NeilfModel(host, config, model.facts)
    plain.load_state_dict({k: v for k, v in model.state_dict().items() if "empty_space" not in k})
    plain.brdf, plain.light = PlainBrdf(plain.brdf), PlainLight(plain.light)
    return plain
