"""Title, number format and meaning of each figure that an evaluation protocol computes, for display."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

__all__ = ["FigureStyle", "style_of"]


@dataclass(frozen=True)
class FigureStyle:
    """How a figure is displayed.

    Attributes:
        title: short name.
        pattern: `%`-style format of the value with its unit.
        better: whether higher or lower values are better.
        meaning: one sentence for the reader of a report.
    """

    title: str
    pattern: str
    better: Literal["higher", "lower", "neither"]
    meaning: str

    def format(self, value: float) -> str:
        """Format a value with its unit."""
        return self.pattern % value


def _decibels(title: str, meaning: str) -> FigureStyle:
    return FigureStyle(title, "%.2f dB", "higher", meaning)


def _length(title: str, meaning: str) -> FigureStyle:
    return FigureStyle(title, "%.4f", "lower", meaning)


def _millimeters(title: str, meaning: str) -> FigureStyle:
    return FigureStyle(title, "%.3f mm", "lower", meaning)


def _similarity(title: str) -> FigureStyle:
    return FigureStyle(title, "%.4f", "higher", "Structural similarity (SSIM); 1 means identical.")


def _log(title: str, meaning: str) -> FigureStyle:
    return FigureStyle(title, "%.3f", "lower", meaning)


def _ratio(title: str) -> FigureStyle:
    meaning = (
        "Error of the half of the pixels with the smaller expected error, over that of the other half; "
        "1 means no better than chance."
    )
    return FigureStyle(title, "%.2f", "lower", meaning)


SCALED_IMAGES = "After the median factor per view and channel, because the exposure of a new view is unknown."
SCALED_LIGHT = "The same after the best factor per channel."

STYLES: Mapping[str, FigureStyle] = {
    "volume_psnr": _decibels(
        "Image, volume rendering", "Test views rendered from the outgoing radiance field, tone-mapped."
    ),
    "volume_ssim": _similarity("Structure, volume rendering"),
    "volume_psnr_linear": _decibels(
        "Image, volume rendering, linear", "On linear radiance, which gives highlights the most weight."
    ),
    "volume_psnr_exposed": _decibels("Image, volume rendering, same exposure", SCALED_IMAGES),
    "pbr_psnr": _decibels(
        "Image, rendering equation", "Test views rendered from material and incident light, tone-mapped."
    ),
    "pbr_ssim": _similarity("Structure, rendering equation"),
    "pbr_psnr_linear": _decibels(
        "Image, rendering equation, linear", "On linear radiance, which gives highlights the most weight."
    ),
    "pbr_psnr_exposed": _decibels("Image, rendering equation, same exposure", SCALED_IMAGES),
    "base_color_psnr": _decibels(
        "Base colour", "As estimated; images determine it only up to a factor per channel."
    ),
    "base_color_psnr_gamma": _decibels(
        "Base colour, one gamma", "After one global exponent that matches the medians."
    ),
    "base_color_psnr_scaled": _decibels(
        "Base colour, scaled", "After the best factor per channel, which images do not determine."
    ),
    "roughness_psnr": _decibels("Roughness", "As estimated; 0 is a mirror, 1 is matte."),
    "metallic_psnr": _decibels("Metallic", "As estimated; 0 is a non-metal, 1 is a metal."),
    "normal_mae_deg": FigureStyle(
        "Normals", "%.2f°", "lower", "Mean angle between estimated and true normals."
    ),
    "chamfer": _length(
        "Surface", "Mean distance between the surfaces, scene units (the object has radius 1)."
    ),
    "chamfer_accuracy": _length(
        "Surface, accuracy", "From the estimate to the truth; surface that should not exist increases it."
    ),
    "chamfer_completeness": _length(
        "Surface, completeness", "From the truth to the estimate; missing surface increases it."
    ),
    "incident_light_log_mae": _log(
        "Incident light", "Mean |ln(estimate/truth)| over points and directions; 0.69 is a factor of 2."
    ),
    "incident_light_log_mae_scaled": _log("Incident light, scaled", SCALED_LIGHT),
    "incident_light_log_mae_occluded": _log(
        "Light from surfaces", "Mean |ln(estimate/truth)| over directions that hit the scene again."
    ),
    "incident_light_log_mae_occluded_scaled": _log("Light from surfaces, scaled", SCALED_LIGHT),
    "render_psnr": _decibels("Image", "Test views, encoded as the protocol requires."),
    "render_ssim": _similarity("Structure of the image"),
    "render_psnr_h": _decibels(
        "Image, linear", "Test views in linear radiance, scaled to display brightness and clipped at 4."
    ),
    "render_psnr_l": _decibels("Image, as displayed", "Test views, clipped and encoded as sRGB."),
    "albedo_psnr": _decibels("Albedo, scaled", "After the factor per channel of the protocol."),
    "albedo_ssim": _similarity("Structure of the albedo, scaled"),
    "albedo_single_psnr": _decibels("Albedo, one factor", "After one factor for all channels."),
    "albedo_single_ssim": _similarity("Structure of the albedo, one factor"),
    "roughness_mse": FigureStyle("Roughness", "%.4f", "lower", "Mean squared error over the frame."),
    "normal_distance": FigureStyle("Normals, 1 − cosine", "%.4f", "lower", "Mean over the eroded mask."),
    "depth_mse": FigureStyle(
        "Depth, scaled", "%.4g", "lower", "Mean squared error after one factor for all views."
    ),
    "chamfer_mm": _millimeters("Surface", "Mean of the two below."),
    "chamfer_accuracy_mm": _millimeters("Surface, accuracy", "From the estimate to the truth."),
    "chamfer_completeness_mm": _millimeters("Surface, completeness", "From the truth to the estimate."),
    "base_color_gamma": FigureStyle(
        "Gamma of base colour",
        "%.3f",
        "neither",
        "The exponent that matches the medians; 1 means no change.",
    ),
    "confidence_base_color_ratio": _ratio("Confidence, base colour"),
    "confidence_roughness_ratio": _ratio("Confidence, roughness"),
    "confidence_metallic_ratio": _ratio("Confidence, metallic"),
}


def style_of(name: str) -> FigureStyle:
    """Look up how a figure is displayed.

    A `baseline_` figure and a `_frame` figure get the entry of their base figure with a changed title. An
    unknown figure gets its own name as title, and neither higher nor lower values count as better.
    """
    if name in STYLES:
        return STYLES[name]
    base = STYLES.get(name.removeprefix("baseline_"))
    if base is not None:
        return replace(
            base,
            title=f"{base.title}, naive baseline",
            meaning="Without a method: a constant, or the mean observed colour.",
        )
    masked = STYLES.get(name.removesuffix("_frame"))
    if masked is not None:
        return replace(
            masked, title=f"{masked.title}, whole frame", meaning="The background counts as free of error."
        )
    return FigureStyle(name.replace("_", " ").capitalize(), "%.4g", "neither", "")
