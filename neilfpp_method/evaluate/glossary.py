"""What each figure of `protocols.evaluate` means, in plain words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

__all__ = ["Entry", "explain"]


@dataclass(frozen=True)
class Entry:
    """How a figure is shown: title, number format (`%`-style), which way is better, and its meaning."""

    title: str
    pattern: str
    better: Literal["higher", "lower", "neither"]
    meaning: str

    def format(self, value: float) -> str:
        """The value with its unit."""
        return self.pattern % value


def _decibels(title: str, meaning: str) -> Entry:
    return Entry(title, "%.2f dB", "higher", meaning)


def _length(title: str, meaning: str) -> Entry:
    return Entry(title, "%.4f", "lower", meaning)


def _millimetres(title: str, meaning: str) -> Entry:
    return Entry(title, "%.3f mm", "lower", meaning)


def _similar(title: str) -> Entry:
    return Entry(title, "%.4f", "higher", "Likeness of local structure; 1 is the same.")


def _log(title: str, meaning: str) -> Entry:
    return Entry(title, "%.3f", "lower", meaning)


def _ratio(title: str) -> Entry:
    meaning = (
        "Error of the surest half of the pixels over that of the other half; 1 is no better than chance."
    )
    return Entry(title, "%.2f", "lower", meaning)


EXPOSED = "New views times the factor per channel that brings each closest, as their exposure is unknown."

ENTRIES: Mapping[str, Entry] = {
    "volume_psnr": _decibels(
        "Image, volume rendering", "New views as the outgoing radiance field shows them, tone-mapped."
    ),
    "volume_ssim": Entry(
        "Structure, volume rendering", "%.4f", "higher", "Likeness of local structure; 1 is the same."
    ),
    "volume_psnr_linear": _decibels(
        "Image, volume rendering, linear", "On linear radiance, where highlights weigh most."
    ),
    "volume_psnr_exposed": _decibels(
        "Image, volume rendering, exposed alike",
        EXPOSED,
    ),
    "pbr_psnr_exposed": _decibels(
        "Image, rendering equation, exposed alike",
        EXPOSED,
    ),
    "pbr_psnr": _decibels(
        "Image, rendering equation", "New views rendered from material and incident light, tone-mapped."
    ),
    "pbr_ssim": Entry(
        "Structure, rendering equation", "%.4f", "higher", "Likeness of local structure; 1 is the same."
    ),
    "pbr_psnr_linear": _decibels(
        "Image, rendering equation, linear", "On linear radiance, where highlights weigh most."
    ),
    "base_color_psnr": _decibels(
        "Base colour", "As estimated, with the free factor between light and base colour."
    ),
    "base_color_psnr_gamma": _decibels(
        "Base colour, one gamma", "After one global exponent that matches the medians."
    ),
    "base_color_psnr_scaled": _decibels(
        "Base colour, scaled", "After the best factor per channel: the free factor is out."
    ),
    "roughness_psnr": _decibels("Roughness", "As estimated; 0 is a mirror, 1 is matt."),
    "metallic_psnr": _decibels("Metallic", "As estimated; 0 is no metal, 1 is metal."),
    "normal_mae_deg": Entry("Normals", "%.2f°", "lower", "Mean angle between estimated and true normals."),
    "chamfer": _length(
        "Surface", "Mean distance between the surfaces, scene units (the object has radius 1)."
    ),
    "chamfer_accuracy": _length(
        "Surface, accuracy", "From the estimate to the truth: what is there and should not be."
    ),
    "chamfer_completeness": _length(
        "Surface, completeness", "From the truth to the estimate: what should be there and is not."
    ),
    "incident_light_log_mae": _log(
        "Incident light", "Mean |ln(estimate/truth)| over points and directions; 0.69 is a factor of 2."
    ),
    "incident_light_log_mae_scaled": _log(
        "Incident light, scaled", "As above, with one factor per channel taken out."
    ),
    "incident_light_log_mae_occluded": _log(
        "Light from surfaces", "As above, over the directions that meet the scene again."
    ),
    "incident_light_log_mae_occluded_scaled": _log(
        "Light from surfaces, scaled", "As above, with one factor per channel taken out."
    ),
    "render_psnr": _decibels("Image", "New views, as the protocol shows them."),
    "render_ssim": _similar("Structure of the image"),
    "render_psnr_h": _decibels(
        "Image, linear", "New views, linear, brought to the level of a display, up to 4."
    ),
    "render_psnr_l": _decibels("Image, as displayed", "New views as a display shows them."),
    "albedo_psnr": _decibels("Albedo, scaled", "After the factor per channel that the protocol takes."),
    "albedo_ssim": _similar("Structure of the albedo, scaled"),
    "albedo_single_psnr": _decibels("Albedo, one factor", "After one factor for all channels."),
    "albedo_single_ssim": _similar("Structure of the albedo, one factor"),
    "roughness_mse": Entry("Roughness", "%.4f", "lower", "Mean squared error over the frame."),
    "normal_distance": Entry("Normals, 1 − cosine", "%.4f", "lower", "Mean over the eroded mask."),
    "depth_mse": Entry(
        "Depth, scaled", "%.4g", "lower", "Mean squared error after one factor for all views."
    ),
    "chamfer_mm": _millimetres("Surface", "Mean of the two below."),
    "chamfer_accuracy_mm": _millimetres("Surface, accuracy", "From the estimate to the truth."),
    "chamfer_completeness_mm": _millimetres("Surface, completeness", "From the truth to the estimate."),
    "base_color_gamma": Entry(
        "Gamma of base colour",
        "%.3f",
        "neither",
        "The power that matches the medians; 1 would change nothing.",
    ),
    "confidence_base_color_ratio": _ratio("Confidence, base colour"),
    "confidence_roughness_ratio": _ratio("Confidence, roughness"),
    "confidence_metallic_ratio": _ratio("Confidence, metallic"),
}


def explain(name: str) -> Entry:
    """The entry of a figure; a baseline has that of its figure, and an unknown figure its own name."""
    if name in ENTRIES:
        return ENTRIES[name]
    base = ENTRIES.get(name.removeprefix("baseline_"))
    if base is not None:
        return replace(
            base, title=f"{base.title}, without a method", meaning="A constant, or the mean image."
        )
    whole = ENTRIES.get(name.removesuffix("_frame"))
    if whole is not None:
        return replace(whole, title=f"{whole.title}, whole frame", meaning="The background counts as right.")
    return Entry(name.replace("_", " ").capitalize(), "%.4g", "higher", "")
