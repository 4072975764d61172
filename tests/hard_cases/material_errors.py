"""Errors of the material and the images of a ball whose truth is known (`known_ball`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tests.hard_cases.known_ball import Array, KnownBall, Photographed


@dataclass(frozen=True)
class Answer:
    """What is found at N rays: base colour (N, 3), roughness and metallic (N, 1) or numbers, and radiances
    (N, 3), shaded (`image`) and rendered by the host (`radiance`).
    """

    base_color: Array
    roughness: Array | float
    metallic: Array | float
    image: Array
    radiance: Array


@dataclass(frozen=True)
class Errors:
    """Errors at points and views that were not trained on.

    Attributes:
        base_color, roughness, metallic: mean absolute errors.
        scaled_base_color: as base_color, after the best factor per channel, for a light that is not known.
        image: mean absolute error of the shaded radiance over the mean radiance.
        radiance: the same of the host's colour.
    """

    base_color: float
    roughness: float
    metallic: float
    scaled_base_color: float
    image: float
    radiance: float


def compare(answer: Answer, ball: KnownBall, truth: Photographed) -> Errors:
    color, wanted = answer.base_color, ball.base_color(truth.normal)
    scale = (color * wanted).sum(0) / np.maximum((color**2).sum(0), 1e-12)
    mean = truth.color.mean()
    return Errors(
        base_color=float(np.abs(color - wanted).mean()),
        roughness=float(np.abs(answer.roughness - ball.roughness).mean()),
        metallic=float(np.abs(answer.metallic - ball.metallic).mean()),
        scaled_base_color=float(np.abs(scale * color - wanted).mean()),
        image=float(np.abs(answer.image - truth.color).mean() / mean),
        radiance=float(np.abs(answer.radiance - truth.color).mean() / mean),
    )
