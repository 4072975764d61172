"""The rendering equation (METHOD §1): stateless mathematics, no parameters.

`frame` has local frames and cosines, `brdf` the BRDF, `sampling` incident directions and their densities,
`rendering_equation` the estimator, `color` the response of cameras, and `albedo` the directional albedo.
"""

from __future__ import annotations

from neilfpp_method.shading.albedo import directional_albedo, initial_albedo
from neilfpp_method.shading.brdf import GGX, LOBES, SPHERICAL_GAUSSIAN, BrdfValue, Lobe, evaluate
from neilfpp_method.shading.color import apply_response, linear_to_srgb, luminance, srgb_to_linear, tone_map
from neilfpp_method.shading.frame import local_frame, safe_normalize
from neilfpp_method.shading.rendering_equation import shade
from neilfpp_method.shading.sampling import Sampling, sample_directions

__all__ = [
    "GGX",
    "LOBES",
    "SPHERICAL_GAUSSIAN",
    "BrdfValue",
    "Lobe",
    "Sampling",
    "apply_response",
    "directional_albedo",
    "evaluate",
    "initial_albedo",
    "linear_to_srgb",
    "local_frame",
    "luminance",
    "safe_normalize",
    "sample_directions",
    "shade",
    "srgb_to_linear",
    "tone_map",
]
