"""Use any ray-based nerfstudio `Model` as a host, unchanged: NeuS, nerfacto with normals, or your own.

| field    | output of the model, the first that it has                                       |
|----------|----------------------------------------------------------------------------------|
| color    | `rgb`: display values (sRGB) or linear values, times `radiance_scale`            |
| position | `expected_depth`, `depth`: distance along the unit ray                           |
| normal   | `normal` (a vector), `pred_normals`, `normals` (colours (n + 1)/2); normalised   |
| opacity  | `accumulation`                                                                   |
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import torch
from jaxtyping import Float, Int
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.models.base_model import Model
from torch import Tensor, nn

from neilfpp_method import losses
from neilfpp_method.data.views import Normalization
from neilfpp_method.errors import UserError
from neilfpp_method.hosts.base import RegularizedHits
from neilfpp_method.hosts.conversion import no_hits
from neilfpp_method.shading.color import srgb_to_linear
from neilfpp_method.shading.frame import safe_normalize
from neilfpp_method.structures import LossTerm, PixelBatch, RayBatch, SurfaceHits

__all__ = ["OWN_LOSSES", "NerfstudioHost"]

OWN_LOSSES = "own"
"""Name of the loss term that holds the model's own losses, weighted already."""

DEPTHS = ("expected_depth", "depth")
NORMALS = ("normal", "pred_normals", "normals")
COLOR_CODED = ("pred_normals", "normals")
"""Outputs that hold normals as colours (n + 1)/2."""
PIXEL_AREA = 1e-6
"""Area of a pixel at distance 1, which cone-casting samplers need: that of an image of 1000 pixels width."""
SAME_FRAME = Normalization(1.0, (0.0, 0.0, 0.0))

Outputs = Mapping[str, Tensor]


class NerfstudioHost(nn.Module):
    """A nerfstudio model behind the host contract.

    Models do not output the distribution of the rendering weight along a ray, so `concentration` is the
    opacity: a ray that grazes two surfaces of a density model counts as a hit between them.

    Args:
        model: a model that takes rays: `NeuSModel`, `NerfactoModel` with `predict_normals`, …
        response: meaning of the rendered colour: "srgb" (trained on 8-bit images) or "linear".
        radiance_scale: linear radiance of a rendered 1; above 1 for a model whose range [0, 1] shows an HDR
            scene.
        frame: transformation between the model's frame (as world frame) and the scene frame, in which the
            object lies in the unit sphere.
        own_losses: whether `render_regularized` adds the term `own`: all losses of the model except
            `rgb_loss`, to be weighted by 1. False if the model is trained elsewhere or not at all.
    """

    def __init__(
        self,
        model: Model,
        *,
        response: str = "srgb",
        radiance_scale: float = 1.0,
        frame: Normalization = SAME_FRAME,
        own_losses: bool = False,
    ) -> None:
        super().__init__()
        self.model = model
        self.name = type(model).__name__
        self.response = response
        self.radiance_scale = radiance_scale
        self.frame = frame
        self.own_losses = own_losses
        # Recorded now: stages change requires_grad later, but some parameters are never trained.
        self._trained = [p for group in model.get_param_groups().values() for p in group if p.requires_grad]

    # -------------------------------------------------------------------------------------- the host contract

    def render(self, rays: RayBatch) -> SurfaceHits:
        """Render rays with the model.

        Raises:
            UserError: the model has no output for the colour, the depth, the normal or the opacity.
        """
        if len(rays) == 0:
            # Some models fail without rays.
            return no_hits(rays)
        first_view = torch.zeros_like(rays.origins[:, 0], dtype=torch.long)
        return self.read_outputs(rays, self._outputs(rays, first_view))

    def render_regularized(self, batch: PixelBatch, names: Collection[str]) -> RegularizedHits:
        """As `render`, with the loss `eikonal` or `own` in training, if the model has it.

        `eikonal` uses the gradients that a `SurfaceModel` outputs in training. With `own_losses` the term
        `own`, with the model's own weights, replaces it.
        """
        if len(batch) == 0:
            return RegularizedHits(no_hits(batch.rays), {})
        outputs = self._outputs(batch.rays, batch.view)
        terms = {}
        if torch.is_grad_enabled() and self.training:
            if self.own_losses:
                terms[OWN_LOSSES] = self._own_losses(outputs, batch)
            elif "eikonal" in names and "eik_grad" in outputs:
                terms["eikonal"] = losses.eikonal(outputs["eik_grad"].reshape(-1, 3))
        return RegularizedHits(self.read_outputs(batch.rays, outputs), terms)

    def parameter_groups(self) -> Mapping[str, list[nn.Parameter]]:
        """All parameters that the model trains, as `geometry`: its fields hold shape and colour together."""
        return {"geometry": self._trained}

    # ---------------------------------------------------------------------------------------------- the model

    def _outputs(self, rays: RayBatch, view: Int[Tensor, " N"]) -> Outputs:
        ones = torch.ones_like(rays.origins[:, :1])
        bundle = RayBundle(
            origins=self.frame.to_world(rays.origins),
            directions=rays.directions,
            pixel_area=PIXEL_AREA * ones,
            camera_indices=view[:, None],
            # Surface models divide the depth by this norm; 1 keeps it a distance along the unit ray.
            metadata={"directions_norm": ones},
        )
        return self.model(bundle)

    def read_outputs(self, rays: RayBatch, outputs: Outputs) -> SurfaceHits:
        """Convert what the model returned for rays to hits.

        Raises:
            UserError: an output is missing.
        """
        depth = outputs[self._first(outputs, DEPTHS, "use a model that renders its depth")] / self.frame.scale
        name = self._first(
            outputs, NORMALS, "switch its normals on (nerfacto: predict_normals=True), or use a surface model"
        )
        normal = 2.0 * outputs[name] - 1.0 if name in COLOR_CODED else outputs[name]
        weights = self._first(outputs, ("accumulation",), "have it output the sum of its weights")
        opacity = outputs[weights][:, 0]
        drawn = outputs[self._first(outputs, ("rgb",), "use a model that renders a color")]
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
        model_losses = self.model.get_loss_dict(outputs, pixels, metrics)
        regularizers = [value for name, value in model_losses.items() if not name.startswith("rgb_loss")]
        return LossTerm(torch.stack(regularizers).sum() if regularizers else batch.color.new_zeros(()))

    def _as_drawn(self, color: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        """Pixels in the units of the model's colour. Pixels and model have the same response."""
        return color if self.response == "srgb" else color / self.radiance_scale
