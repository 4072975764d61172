"""Any ray-based nerfstudio `Model` as a host, unchanged: NeuS, nerfacto with normals, or your own.

| of the host | output of the model, the first that it has                                       |
|-------------|----------------------------------------------------------------------------------|
| color       | `rgb`: display values (sRGB) or linear, times the radiance that its 1 stands for |
| position    | `expected_depth`, `depth`: distance along a unit ray                             |
| normal      | `normal` (a vector), `pred_normals`, `normals` (colours (n + 1)/2), made unit    |
| opacity     | `accumulation`                                                                   |
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import torch
from jaxtyping import Float, Int
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.models.base_model import Model
from torch import Tensor, nn

from neilfpp_method import losses
from neilfpp_method.data.views import Normalisation
from neilfpp_method.errors import UserError
from neilfpp_method.hosts.answers import no_hits
from neilfpp_method.hosts.base import RegularisedHits
from neilfpp_method.shading.color import srgb_to_linear
from neilfpp_method.shading.frame import safe_normalize
from neilfpp_method.structures import LossTerm, PixelBatch, RayBatch, SurfaceHits

__all__ = ["OWN_LOSSES", "NerfstudioHost"]

OWN_LOSSES = "own"
"""Name of the term that holds what the model asks of itself; it is weighted already."""

DEPTHS = ("expected_depth", "depth")
NORMALS = ("normal", "pred_normals", "normals")
COLOR_CODED = ("pred_normals", "normals")
# Cone-casting samplers read a pixel's area at distance 1; traced rays get that of a 1000-pixel view.
PIXEL_AREA = 1e-6
SAME_FRAME = Normalisation(1.0, (0.0, 0.0, 0.0))

Outputs = Mapping[str, Tensor]


class NerfstudioHost(nn.Module):
    """A nerfstudio model behind the host contract.

    The share of weight that lies close to the hit is not among a model's outputs: `concentration` is the
    opacity. A ray that grazes two surfaces of a density model counts as a hit between them.

    Args:
        model: a model that takes rays; `NeuSModel`, `NerfactoModel` with `predict_normals`, …
        response: what the model draws: "srgb" (trained on 8-bit images) or "linear".
        radiance_scale: the linear radiance that a drawn 1 stands for; above 1 for a model that draws [0, 1]
            of an HDR scene.
        frame: from the model's frame, as world, to the scene frame, where the object lies in the unit sphere.
        own_losses: `render_regularised` adds the term `own`: the model's own losses but its `rgb_loss`. The
            caller weighs it with 1. Off: the model is trained elsewhere, or not at all.
    """

    def __init__(
        self,
        model: Model,
        *,
        response: str = "srgb",
        radiance_scale: float = 1.0,
        frame: Normalisation = SAME_FRAME,
        own_losses: bool = False,
    ) -> None:
        super().__init__()
        self.model = model
        self.name = type(model).__name__
        self.response = response
        self.radiance_scale = radiance_scale
        self.frame = frame
        self.own_losses = own_losses
        # Noted now: a stage that freezes the host unfreezes it later, and some parameters never move.
        self._moving = [p for group in model.get_param_groups().values() for p in group if p.requires_grad]

    # -------------------------------------------------------------------------------------- the host contract

    def render(self, rays: RayBatch) -> SurfaceHits:
        """What the model says of each ray.

        Raises:
            UserError: the model has no output for the colour, the depth, the normal or the opacity.
        """
        if len(rays) == 0:  # some models cannot be asked for nothing
            return no_hits(rays)
        return self.read_outputs(
            rays, self._ask(rays, torch.zeros_like(rays.origins[:, 0], dtype=torch.long))
        )

    def render_regularised(self, batch: PixelBatch, names: Collection[str]) -> RegularisedHits:
        """As `render`, with `eikonal` or `own` where the model has them and a gradient flows.

        `eikonal` is asked for by its name, and counts the gradients that a `SurfaceModel` hands out in
        training. With `own_losses` the model's own, with its own weights, stands in for it.
        """
        if len(batch) == 0:
            return RegularisedHits(no_hits(batch.rays), {})
        outputs = self._ask(batch.rays, batch.view)
        terms = {}
        if torch.is_grad_enabled() and self.training:
            if self.own_losses:
                terms[OWN_LOSSES] = self._own_losses(outputs, batch)
            elif "eikonal" in names and "eik_grad" in outputs:
                terms["eikonal"] = losses.eikonal(outputs["eik_grad"].reshape(-1, 3))
        return RegularisedHits(self.read_outputs(batch.rays, outputs), terms)

    def parameter_groups(self) -> Mapping[str, list[nn.Parameter]]:
        """All that the model would train, as `geometry`: a nerfstudio field holds shape and colour in one."""
        return {"geometry": self._moving}

    # ---------------------------------------------------------------------------------------------- the model

    def _ask(self, rays: RayBatch, view: Int[Tensor, " N"]) -> Outputs:
        ones = torch.ones_like(rays.origins[:, :1])
        bundle = RayBundle(
            origins=self.frame.to_world(rays.origins),
            directions=rays.directions,
            pixel_area=PIXEL_AREA * ones,
            camera_indices=view[:, None],
            # Surface models divide their depth by it; with 1 it stays a distance along the unit ray.
            metadata={"directions_norm": ones},
        )
        return self.model(bundle)

    def read_outputs(self, rays: RayBatch, outputs: Outputs) -> SurfaceHits:
        """The hits of rays, from what the model returned for them.

        Raises:
            UserError: an output is missing.
        """
        depth = outputs[self._first(outputs, DEPTHS, "use a model that renders its depth")] / self.frame.scale
        name = self._first(
            outputs, NORMALS, "switch its normals on (nerfacto: predict_normals=True), or use a surface model"
        )
        normal = 2.0 * outputs[name] - 1.0 if name in COLOR_CODED else outputs[name]
        opacity = outputs[self._first(outputs, ("accumulation",), "have it output the sum of its weights")][
            :, 0
        ]
        drawn = outputs[self._first(outputs, ("rgb",), "use a model that renders a colour")]
        linear = srgb_to_linear(drawn) if self.response == "srgb" else drawn
        return SurfaceHits(
            color=self.radiance_scale * linear,
            position=rays.origins + depth * rays.directions,
            normal=safe_normalize(normal),
            opacity=opacity,
            concentration=opacity.detach(),
        )

    def _first(self, outputs: Outputs, names: tuple[str, ...], remedy: str) -> str:
        for name in names:
            if name in outputs:
                return name
        wanted = " or ".join(f"'{name}'" for name in names)
        raise UserError(f"{self.name} gives no output {wanted}", remedy)

    def _own_losses(self, outputs: Outputs, batch: PixelBatch) -> LossTerm:
        pixels = {"image": self._as_drawn(batch.color)}
        metrics = self.model.get_metrics_dict(outputs, pixels)
        asked = self.model.get_loss_dict(outputs, pixels, metrics)
        regularisers = [value for name, value in asked.items() if not name.startswith("rgb_loss")]
        return LossTerm(torch.stack(regularisers).sum() if regularisers else batch.color.new_zeros(()))

    def _as_drawn(self, color: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """A pixel in the units that the model draws in; a pixel's response and the model's are the same."""
        return color if self.response == "srgb" else color / self.radiance_scale
