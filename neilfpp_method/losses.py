"""The losses of METHOD §4, each unreduced and unweighted; `schedule.py` weighs and adds them up."""

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
    "point_cloud",
    "scale_gradient",
    "smoothness",
    "surface",
]


def photometric(
    radiance: Float[Tensor, "N 3"], pixel: Float[Tensor, "N 3"], response: str, unit: float = 1.0
) -> LossTerm:
    """L_vol and L_phys: L1 between a render and the pixel; at a clipped one as far as the render is darker.

    Args:
        radiance: what the model sees, linear.
        pixel: what the file holds, in the capture's `response`.
        response: "linear" compares radiance; "srgb" encodes the render first, and takes a pixel at the upper
            end of the range for a lower bound (`shading.color.residual`; METHOD §6 clips the render, which
            has no gradient where it is too bright).
        unit: what the difference is measured in: with the range of an output activation, the gradient keeps
            its size.
    """
    return LossTerm(residual(radiance, pixel, response).abs() / unit)


def mask(
    opacity: Float[Tensor, " N"],
    depth: Float[Tensor, " N"],
    object_mask: Float[Tensor, " N"],
    known: Float[Tensor, " N"],
) -> LossTerm:
    """On the object 1 − opacity; off it ln(1 + τ), τ the optical depth; where the mask is known.

    Opacity itself has no slope behind a solid, 1 − e^−τ: what stands where nothing may stand would stay there
    for good, painted like the background. The cross-entropy of IDR is τ, and its slope grows without bound as
    surfaces become sharp, which is what a mask that is wrong by a pixel brings about along every silhouette.
    """
    return LossTerm(known * (object_mask * (1 - opacity) + (1 - object_mask) * depth.log1p()))


def exposure(drift: Float[Tensor, "V 3"]) -> LossTerm:
    """The squares of how far the log gains of photographs are from what they started as."""
    return LossTerm(drift.square())


def eikonal(gradient: Float[Tensor, "P 3"]) -> LossTerm:
    """L_Eik = |‖∇G‖ − 1|; finite gradients where ∇G = 0."""
    return LossTerm((_safe_norm(gradient) - 1.0).abs())


def hessian(matrix: Float[Tensor, "P 3 3"]) -> LossTerm:
    """L_Hess = ‖H G‖₁, element-wise: flat surfaces cost nothing, noise does."""
    return LossTerm(matrix.abs())


def surface(distance: Float[Tensor, ...], epsilon: float) -> LossTerm:
    """L_surf = δ_ε(G), δ_ε(z) = ε / (π (ε² + z²)): the zero set's area, against unseen surfaces."""
    return LossTerm(epsilon / (math.pi * (epsilon**2 + distance**2)))


def point_cloud(
    distance: Float[Tensor, " P"], gradient: Float[Tensor, "P 3"], normal: Float[Tensor, "P 3"]
) -> LossTerm:
    """L_pcd = |G(x_D)| + 1 − cos∠(n_D, ∇G(x_D)) at the points x_D of an oriented cloud."""
    cosine = (functional.normalize(gradient, dim=-1, eps=1e-6) * normal).sum(-1)
    return LossTerm(distance.abs() + (1.0 - cosine))


def inter_reflection(
    incident: Float[Tensor, "K 3"],
    outgoing: Float[Tensor, "K 3"],
    unit: float = 1.0,
    monochrome: bool = False,
) -> LossTerm:
    """L_ref = ‖L(x₁, ωi) − R(x₂, −ωi)‖₁ for rays from x₁ along ωi that hit at x₂, in a unit of radiance.

    A light without colour is compared by luminance: no L can meet three channels that differ.
    """
    if monochrome:
        incident, outgoing = luminance(incident)[:, None], luminance(outgoing)[:, None]
    return LossTerm((incident - outgoing).abs() / unit)


def smoothness(
    roughness_gradient: Float[Tensor, "N 3"],
    metallic_gradient: Float[Tensor, "N 3"],
    image_gradient: Float[Tensor, " N"],
) -> LossTerm:
    """L_smth = (‖∇r‖ + ‖∇m‖) exp(−‖∇I‖): roughness and metallic change where the image does."""
    return LossTerm(
        (_safe_norm(roughness_gradient) + _safe_norm(metallic_gradient)) * torch.exp(-image_gradient)
    )


def lambertian(material: Material) -> LossTerm:
    """L_Lam = |r − 1| + |m|: without evidence a surface is rough and not a metal."""
    return LossTerm((material.roughness - 1.0).abs() + material.metallic.abs())


def scale_gradient(value: Tensor, scale: float) -> Tensor:
    """The same value with its gradient times `scale`; 0 detaches it."""
    if scale == 1.0:
        return value
    if scale == 0.0:
        return value.detach()
    return value * scale + value.detach() * (1.0 - scale)


def _safe_norm(vector: Float[Tensor, "P 3"]) -> Float[Tensor, " P"]:
    # The floor keeps the derivative of the root finite at zero and moves no length that matters.
    return vector.square().sum(-1).clamp_min(1e-12).sqrt()
