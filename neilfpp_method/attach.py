"""`attach_neilf`: material and light on top of somebody else's geometry and radiance, in somebody else's loop.

Three lines, the last one in every step:

    neilf = attach_neilf(host)
    optimizer.add_param_group({"params": neilf.parameters()})
    loss = loss + neilf.losses(batch, step).loss
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.data.environment_map import read_environment
from neilfpp_method.errors import UserError
from neilfpp_method.hosts.base import HasParameterGroups, Host, LightsItself
from neilfpp_method.hosts.outputs import check_tensors, host_name
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, StagePosition, Total, active_losses, stage_at, weigh
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.presets import free_light, preset
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.structures import Material, PixelBatch, RayBatch, Shading, SurfaceHits

__all__ = ["AttachedNeilf", "CallableHost", "attach_neilf", "missing_capabilities", "pixel_batch"]

RenderFunction = Callable[[Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]

RADIANCE_SCALE = {"linear": 3.0, "srgb": 1.0}
"""METHOD §5: how far R's sigmoid reaches for HDR and for LDR images."""

WITHOUT = {
    "render_regularised": "no losses of its own on the geometry",
    "surface_width": "rays for L_ref start at a fixed distance from the surface",
    "parameter_groups": "its own trainer moves it",
    "sdf": "no mesh to export",
    "scene_light": "hard inter-reflection renders every ray",
}
"""The optional methods of a host, and what is lost without each."""

log = logging.getLogger(__name__)


class CallableHost:
    """A function (origins, directions) → (color, position, normal) as a host.

    A ray misses where its normal is shorter than one half or not finite. This is no `nn.Module`: a function that is one
    stays where it belongs.
    """

    def __init__(self, function: RenderFunction) -> None:
        self.function = function
        self.name = getattr(function, "__qualname__", type(function).__name__)

    def render(self, rays: RayBatch) -> SurfaceHits:
        """The function's answer; opacity and concentration are 1 for a hit, 0 for a miss.

        Raises:
            UserError: it does not return three tensors of the right shape on the device of the rays.
        """
        answer = self.function(rays.origins, rays.directions)
        if not isinstance(answer, tuple | list) or len(answer) != 3:
            kind = f"{len(answer)} values" if isinstance(answer, tuple | list) else f"a {type(answer).__name__}"
            raise UserError(f"{self.name}: returns {kind}", "return color, position and normal, each (N, 3)")
        check_tensors(self.name, rays, dict(zip(("color", "position", "normal"), answer, strict=True)))
        color, position, normal = answer
        hit = normal.detach().square().sum(-1) > 0.25  # not so for NaN
        position = torch.where(hit[:, None], position, rays.origins)
        share = hit.to(color.dtype)
        return SurfaceHits(color, position, torch.where(hit[:, None], normal, 0.0), share, share)


class AttachedNeilf(nn.Module):
    """Material and light of a scene whose geometry and radiance a host knows.

    A host that offers `parameter_groups` is trained with the rest: `parameters()` holds its parameters, and all three
    stages of the paper run. Any other is borrowed: nothing of it is in `parameters()`, `state_dict()`, `to()` or
    `train()`, and nothing is computed in the first stage, which is its own trainer's. In the material stage it is asked
    without gradients. In the joint stage gradients reach it.

    Attributes:
        model: the method itself; `model.maps(rays)` gives every map of a view.
        light_solver: remembers what steps showed, and solves for the light now and then.
        missing: the optional methods that the host does not have, and what is lost without each.
    """

    def __init__(self, model: NeilfModel) -> None:
        super().__init__()
        self.model = model
        self.light_solver = model.light_solver()
        self.missing = missing_capabilities(model.host)

    def forward(self, batch: PixelBatch, step: int | Stage) -> Total:
        """`losses`, under the name that data-parallel wrappers call."""
        return self.losses(batch, step)

    def losses(self, batch: PixelBatch, step: int | Stage) -> Total:
        """The weighted sum of what counts in a step, to add to a loss of your own, and each term before its weight.

        Args:
            batch: pixels with their rays in the scene frame; see `pixel_batch`.
            step: the number of the step, from 0, which `config.train` places in its stage; or a stage by name.

        Raises:
            UserError: the host returned what cannot be used, or the batch is on another device.
        """
        place, own = batch.origins.device, next(self.model.brdf.parameters()).device
        if place != own:
            raise UserError(f"rays on {place}, material and light on {own}", "move one of them: neilf.to(device)")
        position = StagePosition(step, 0, 1) if isinstance(step, Stage) else stage_at(step, self.model.config.train)
        computed = self.model(batch, position.stage)
        if not computed.terms:
            # A loop without a loss of its own may still call backward.
            return Total(torch.zeros((), device=place, requires_grad=True), {})
        if self.training:
            self.light_solver.observe(computed)
            self.light_solver.solve(self.model.brdf, self.model.scene)
        return weigh(computed.terms, active_losses(position.stage, self.model.config, self.model.stages, position.share))

    def parameter_groups(self) -> Mapping[str, list[nn.Parameter]]:
        """The parameters by field, for a learning rate each (`config.optimizer`)."""
        return self.model.parameter_groups()

    def materials(self, x: Float[Tensor, "N 3"]) -> Material:
        """Base colour, roughness and metallic at points of the scene frame."""
        return self.model.materials(x)

    def incident_light(self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"]) -> Float[Tensor, "N S 3"]:
        """Linear radiance that arrives at x from wi."""
        return self.model.incident_light(x, wi)

    def shade(self, hits: SurfaceHits, wo: Float[Tensor, "N 3"]) -> Shading:
        """What the rendering equation sends towards wo from the hits of rays; zero where there is no hit."""
        settings = self.model.config.shading
        rows = torch.nonzero(hits.is_hit(settings.hit_share))[:, 0]
        position = hits.position[rows]
        samples = settings.train_samples if self.training else settings.eval_samples
        normal = self.model.shading_normals(position, hits.normal[rows])
        shading = self.model.shade(position, normal, wo[rows], self.materials(position), samples)
        nothing = torch.zeros_like(wo)
        return Shading(*(nothing.index_put((rows,), part) for part in (shading.color, shading.diffuse, shading.specular)))


def attach_neilf(
    host: Any,
    config: NeilfConfig | None = None,
    *,
    response: str = "linear",
    median_radiance: float = 0.5,
    radiance_scale: float | None = None,
    open_scene: bool = False,
) -> AttachedNeilf:
    """Put the material field, the light field and their losses on top of a host.

    Args:
        host: an object with `render(rays) -> SurfaceHits`; a function (origins, directions) → (color, position,
            normal); or a nerfstudio model. In a frame where the object lies in the unit sphere.
        config: the settings; none: the preset `fast`, with the free light field on a host that cannot trace cheaply. For
            a host that is trained already, set `train.sdf_steps` to 0.
        response: what the pixels are: "linear" (HDR) or "srgb" (LDR).
        median_radiance: median linear luminance of the object in the images; sets the light's first guess.
        radiance_scale: the range of the host's radiance; none: 3 for HDR, 1 for LDR.
        open_scene: pixels of rays that meet nothing show the light from far away, not a backdrop; a map keeps to them.

    Raises:
        UserError: the host is none of the three, or the environment map that the settings name cannot be used.
    """
    adapted = _adapt(host, response)
    borrowed = not isinstance(host, HasParameterGroups)
    background = "inverted_sphere" if open_scene else "constant"
    facts = SceneFacts(response, median_radiance, radiance_scale or RADIANCE_SCALE[response], background)
    if config is None:
        config = preset("fast") if isinstance(adapted, LightsItself) else free_light(preset("fast"))
    attached = AttachedNeilf(NeilfModel(adapted, config, facts, borrowed=borrowed))
    if config.known_map is not None:
        attached.model.light.show(read_environment(Path(config.known_map)))
    if attached.missing:
        lost = "; ".join(f"no {name}: {loss}" for name, loss in attached.missing.items())
        log.warning("NeILF++ attached to %s, which has %s", host_name(adapted), lost)
    return attached


def missing_capabilities(host: object) -> Mapping[str, str]:
    """The optional methods that a host does not have, and what is lost without each."""
    return {name: loss for name, loss in WITHOUT.items() if not hasattr(host, name)}


def pixel_batch(
    origins: Float[Tensor, "N 3"],
    directions: Float[Tensor, "N 3"],
    color: Float[Tensor, "N 3"],
    mask: Float[Tensor, " N"] | None = None,
) -> PixelBatch:
    """Pixels of a loop that knows rays and colours, and perhaps where the object is."""
    nothing = torch.zeros_like(origins[:, 0])
    return PixelBatch(
        origins=origins,
        directions=directions,
        color=color,
        mask=nothing + 1.0 if mask is None else mask,
        mask_known=nothing if mask is None else nothing + 1.0,
        image_gradient=nothing,
        view=nothing.long(),
    )


def _adapt(host: object, response: str) -> Host:
    if isinstance(host, nn.Module) and hasattr(host, "get_outputs") and hasattr(host, "config"):
        from neilfpp_method.hosts.nerfstudio import NerfstudioHost

        return NerfstudioHost(host, response=response)
    if isinstance(host, Host):
        return host
    if callable(host):
        return CallableHost(host)
    raise UserError(
        f"{type(host).__name__} is no host",
        "give an object with render(rays) -> SurfaceHits, or a function of (origins, directions)",
    )
