"""The loss terms of METHOD §4, unreduced and unweighted; `schedule.weigh` reduces, weights and sums them."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from neilfpp_method.shading.color import luminance, residual
from neilfpp_method.structures import LossTerm, Material

__all__ = [
    "eikonal",
    "exposure",
    "hessian",
    "inter_reflection",
    "lambertian",
    "mask",
    "photometric",
    "physical",
    "point_cloud",
    "scale_gradient",
    "smoothness",
    "surface",
    "tilt",
]

MISS_DISTANCE = 0.02
"""Distance by which a ray misses the object, scene units, at which its mask loss grows by 1."""
TINY_DEPTH = 1e-12
"""Optical depths are raised to at least this value, so that the gradient of their logarithm is finite. A ray
that misses the surface by 28 β has it.
"""
TINY_GRADIENT = 1e-6
"""Lengths of gradients are at least this, so that the gradient of the length is finite."""
MIN_SLOPE = 0.01
"""Gradient of roughness or metallic, per scene unit, below which L_smth has no effect."""


def photometric(
    radiance: Float[Tensor, "N 3"], pixel: Float[Tensor, "N 3"], response: str, unit: float = 1.0
) -> LossTerm:
    """L_vol: L1 distance between a rendered colour and the pixel.

    Args:
        radiance: rendered linear radiance.
        pixel: pixel value in the capture's `response`.
        response: "linear" compares radiance. "srgb" encodes the render first. A clipped pixel is then a lower
            bound: only a darker render has a loss (`shading.color.residual`). METHOD §6 clips the render
            instead, which has no gradient where the render is too bright.
        unit: unit of the difference. With the range of R's output activation as unit, the gradient does not
            depend on that range.
    """
    return LossTerm(residual(radiance, pixel, response).abs() / unit)


def physical(
    one: Float[Tensor, "N 3"],
    other: Float[Tensor, "N 3"],
    pixel: Float[Tensor, "N 3"],
    response: str,
    unit: float = 1.0,
) -> LossTerm:
    """L_phys: L1 distance between the pixel and a radiance of which there are two independent estimates.

    The expected absolute error of an estimate grows with its noise, so its minimum is at materials that are
    rendered with little noise. Here each estimate gets its gradient with the sign of the error of the other
    one, so that the gradient of the noise has the expectation 0. This is the dual buffer of Deng et al.
    (2022, "Reconstructing Translucent Objects Using Differentiable Rendering"), for the absolute error. Its
    minimum is where the median of an estimate is the pixel, which under skewed noise is not the mean
    (docs/stability.md).

    Args:
        one, other: linear radiance, estimated from independent samples of the incident light. If both are the
            same estimate, this is `photometric`.
        pixel, response, unit: as for `photometric`.

    Returns:
        The absolute error of the mean of both, with that gradient.
    """
    first, second = residual(one, pixel, response), residual(other, pixel, response)
    crossed = 0.5 * (first * second.detach().sign() + second * first.detach().sign())
    error = 0.5 * (first + second).detach().abs()
    return LossTerm((error + crossed - crossed.detach()) / unit)


def mask(
    depth: Float[Tensor, " N"],
    object_mask: Float[Tensor, " N"],
    known: Float[Tensor, " N"],
    beta: Float[Tensor, ""],
) -> LossTerm:
    """Mask loss: ln(1 + τ) off the object, and e^−τ + β/d ln(1 + 1/τ) on it, with d = `MISS_DISTANCE`.

    τ is the optical depth of the ray. A loss on the opacity 1 − e^−τ alone has no gradient where it is wrong:

    - Off the object, behind a solid surface. Geometry in known empty space would stay and be painted like the
      background. The cross-entropy of IDR equals τ there; its gradient grows without bound as surfaces become
      sharp, and masks that are wrong by a pixel along the silhouettes would carve the object.
    - On the object, where a ray misses the surface by more than a few β. Parts of the object that have shrunk
      would stay so. The density is e^(−distance/β) there, so that −β ln τ is the distance up to a constant.

    Args:
        depth: optical depth τ of each ray.
        object_mask: 1 on the object, 0 off it.
        known: 1 where the mask is known; the loss is 0 elsewhere.
        beta: scale β of the density, scene units.
    """
    missed = beta / MISS_DISTANCE * functional.softplus(-depth.clamp_min(TINY_DEPTH).log())
    on_object, off_object = torch.exp(-depth) + missed, depth.log1p()
    return LossTerm(known * (object_mask * on_object + (1 - object_mask) * off_object))


def exposure(drift: Float[Tensor, "V 3"]) -> LossTerm:
    """Prior on the gains of photographs: the squared drift of their logarithms from the initial values."""
    return LossTerm(drift.square())


def eikonal(gradient: Float[Tensor, "P 3"]) -> LossTerm:
    """L_Eik = |‖∇G‖ − 1|. Its gradient is finite where ∇G = 0."""
    return LossTerm((_norm(gradient, TINY_GRADIENT) - 1.0).abs())


def hessian(matrix: Float[Tensor, "P 3 3"]) -> LossTerm:
    """L_Hess = ‖H G‖₁, element-wise on the Hessian of G: 0 for planes, large for noisy surfaces."""
    return LossTerm(matrix.abs())


def surface(distance: Float[Tensor, ...], epsilon: float) -> LossTerm:
    """L_surf = δ_ε(G) with δ_ε(z) = ε / (π (ε² + z²)): the area of the zero set, against unseen surfaces."""
    return LossTerm(epsilon / (math.pi * (epsilon**2 + distance**2)))


def point_cloud(
    distance: Float[Tensor, " P"], gradient: Float[Tensor, "P 3"], normal: Float[Tensor, "P 3"]
) -> LossTerm:
    """L_pcd = |G(x_D)| + 1 − cos∠(n_D, ∇G(x_D)) at points x_D with normals n_D of an oriented point cloud."""
    cosine = (functional.normalize(gradient, dim=-1, eps=1e-6) * normal).sum(-1)
    return LossTerm(distance.abs() + (1.0 - cosine))


def inter_reflection(
    incident: Float[Tensor, "K 3"],
    outgoing: Float[Tensor, "K 3"],
    unit: float = 1.0,
    monochrome: bool = False,
) -> LossTerm:
    """L_ref = ‖L(x₁, ωi) − R(x₂, −ωi)‖₁ for rays from x₁ along ωi that hit the scene at x₂.

    Args:
        incident: L(x₁, ωi), linear.
        outgoing: R(x₂, −ωi), linear.
        unit: radiance by which the difference is divided.
        monochrome: L has one channel, so the luminances are compared.
    """
    if monochrome:
        incident, outgoing = luminance(incident)[:, None], luminance(outgoing)[:, None]
    return LossTerm((incident - outgoing).abs() / unit)


def smoothness(
    roughness_gradient: Float[Tensor, "N 3"],
    metallic_gradient: Float[Tensor, "N 3"],
    image_gradient: Float[Tensor, " N"],
) -> LossTerm:
    """L_smth = (‖∇r‖ + ‖∇m‖) exp(−‖∇I‖): roughness and metallic are smooth where the image is smooth.

    Gradients shorter than `MIN_SLOPE` have no effect. The norm has a kink at 0, and in an almost constant
    field rounding would decide in which direction the loss changes it.
    """
    slopes = _norm(roughness_gradient, MIN_SLOPE) + _norm(metallic_gradient, MIN_SLOPE)
    return LossTerm(slopes * torch.exp(-image_gradient))


def lambertian(material: Material) -> LossTerm:
    """L_Lam = |r − 1| + |m|: without evidence to the contrary a surface is rough and not metallic."""
    return LossTerm((material.roughness - 1.0).abs() + material.metallic.abs())


def tilt(vector: Float[Tensor, "N 3"]) -> LossTerm:
    """Prior on the tilts of normals: the squared angle (radians) by which they correct the geometry."""
    return LossTerm(vector.square().sum(-1))


def scale_gradient(value: Tensor, scale: float) -> Tensor:
    """Return `value` with its gradient multiplied by `scale`; 0 detaches it."""
    if scale == 1.0:
        return value
    if scale == 0.0:
        return value.detach()
    return value * scale + value.detach() * (1.0 - scale)


def _norm(vector: Float[Tensor, "P 3"], shortest: float) -> Float[Tensor, " P"]:
    """Lengths, at least `shortest`; below it the gradient is 0, and at 0 it is finite."""
    return vector.square().sum(-1).clamp_min(shortest**2).sqrt()
