"""Use a nerfstudio method as the host: `--pipeline.model.host neus`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.fields import sdf_field
from nerfstudio.models.base_model import Model, ModelConfig
from nerfstudio.utils import external

from neilfpp_method.errors import UserError

__all__ = ["ForeignModel", "build_foreign", "has_distance_field"]

HOSTS = ("nerfacto", "nerfacto-big", "nerfacto-huge", "phototourism", "neus", "neus-facto")
"""Nerfstudio's methods whose models render colour, depth, normals and opacity of rays, and whose losses need
only the images. The others have no normals, render a coarse and a fine image, need depths or semantics, or do
not render rays.
"""
WANTED = {
    "predict_normals": True,
    "use_appearance_embedding": False,
    "camera_optimizer": CameraOptimizerConfig(mode="off"),
}
"""Options that a host needs: normals, and a colour that depends on position and direction but not on the
image.
"""


@dataclass(frozen=True)
class ForeignModel:
    """A nerfstudio model, and the learning rate with which its own method trains it."""

    model: Model
    rate: float


def build_foreign(name: str, arguments: Mapping[str, Any]) -> ForeignModel:
    """Build the untrained model of a nerfstudio method.

    Args:
        name: name of the method in `ns-train`.
        arguments: arguments of nerfstudio's model constructor: scene box, number of images, device, …

    Raises:
        UserError: if the method cannot be a host, or needs a package that is missing.
    """
    method = _method(name)
    config: ModelConfig = method.pipeline.model
    known = {field.name for field in dataclasses.fields(config)}
    config = dataclasses.replace(config, **{key: value for key, value in WANTED.items() if key in known})
    rates = [settings["optimizer"].lr for settings in method.optimizers.values()]
    if has_distance_field(name):
        _check_tiny_cuda_nn(name)
    return ForeignModel(config.setup(**arguments), min(rates))


def has_distance_field(name: str) -> bool:
    """Whether the model of a method, one of `HOSTS`, has a distance field."""
    return hasattr(_method(name).pipeline.model, "sdf_field")


def _method(name: str) -> Any:
    """The configuration of a method that can be a host.

    Raises:
        UserError: if it is not one of `HOSTS`.
    """
    # Nerfstudio's table of methods contains this plugin, so it can only be imported after the plugin.
    from nerfstudio.configs.method_configs import method_configs

    if name not in HOSTS:
        problem = "it does not render all that a host needs" if name in method_configs else "no such method"
        raise UserError(f"no host '{name}': {problem}", f"choose one of {', '.join(HOSTS)}")
    return method_configs[name]


def _check_tiny_cuda_nn(name: str) -> None:
    """Check that nerfstudio's distance field, which has no other hash grid, finds tiny-cuda-nn.

    Raises:
        UserError: if it was not imported. Nerfstudio alone would fail with an unrelated attribute.
    """
    if sdf_field.tcnn is not external.tcnn or external.TCNN_EXISTS:
        return
    remedy = "install it (docs.nerf.studio, Installation), or choose the host nerfacto"
    if not torch.cuda.is_available():
        remedy = "that needs a CUDA device, which torch does not find here: choose the host nerfacto"
    raise UserError(f"the host {name} needs tiny-cuda-nn ({external.tcnn_import_exception})", remedy)
