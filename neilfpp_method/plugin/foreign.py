"""Use a nerfstudio method as the host: `--pipeline.model.host neus`."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.data.datamanagers.base_datamanager import VanillaDataManagerConfig
from nerfstudio.models.base_model import Model, ModelConfig

from neilfpp_method.errors import UserError

__all__ = ["ForeignModel", "build_foreign"]

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
        UserError: if there is no such method, or if it does not render rays.
    """
    # Nerfstudio's table of methods contains this plugin, so it can only be imported after the plugin.
    from nerfstudio.configs.method_configs import method_configs

    rays = {key: method for key, method in method_configs.items() if _takes_rays(method)}
    if name not in rays:
        raise UserError(f"no host '{name}'", f"choose a method that renders rays: {', '.join(rays)}")
    config: ModelConfig = rays[name].pipeline.model
    known = {field.name for field in dataclasses.fields(config)}
    config = dataclasses.replace(config, **{key: value for key, value in WANTED.items() if key in known})
    rates = [settings["optimizer"].lr for settings in rays[name].optimizers.values()]
    return ForeignModel(config.setup(**arguments), min(rates))


def _takes_rays(method: Any) -> bool:
    pipeline = getattr(method, "pipeline", None)
    return isinstance(getattr(pipeline, "datamanager", None), VanillaDataManagerConfig)
