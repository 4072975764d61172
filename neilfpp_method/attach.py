"""`attach_neilf`: material and light on top of another system's geometry and radiance, in its own loop.

Three lines, the last one in every step:

    neilf = attach_neilf(host)
    for group in neilf.param_groups(): optimizer.add_param_group(group)
    loss = loss + neilf.losses(batch, step).loss
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.data.environment_map import read_environment
from neilfpp_method.data.views import Camera
from neilfpp_method.errors import UserError
from neilfpp_method.health.cases import Health
from neilfpp_method.health.guard import StepGuard
from neilfpp_method.health.look import look_at_hits
from neilfpp_method.health.watch import Watch
from neilfpp_method.hosts.answers import Rendered, as_hits
from neilfpp_method.hosts.base import HasParameterGroups, Host, ImageHost, LightsItself
from neilfpp_method.hosts.capabilities import CAPABILITIES
from neilfpp_method.hosts.first_look import FirstLook, check_batch, check_points, check_rows
from neilfpp_method.hosts.foreign import ForeignHost, answers_secondary_rays, proxy_for
from neilfpp_method.hosts.function import CallableHost
from neilfpp_method.hosts.outputs import host_name
from neilfpp_method.hosts.proxy import SurfaceProxy
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, StagePosition, Total, active_losses, stage_at, weigh
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.presets import preset
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.structures import Maps, Material, PixelBatch, RayBatch, Shading, StepResult, SurfaceHits

__all__ = ["AttachedNeilf", "CallableHost", "attach_neilf", "missing_capabilities", "pixel_batch"]

RADIANCE_SCALE = {"linear": 3.0, "srgb": 1.0}
"""METHOD §5: how far R's sigmoid reaches for HDR and for LDR images."""

log = logging.getLogger(__name__)


class AttachedNeilf(nn.Module):
    """Material and light of a scene whose geometry and radiance a host knows.

    A host that offers `parameter_groups` is trained with the rest: `parameters()` holds its parameters, and
    all three stages of the paper run. Any other is borrowed: nothing of it is in `parameters()`,
    `state_dict()`, `to()` or `train()`, and nothing is computed in the first stage, which is its own
    trainer's. In the material stage it is asked without gradients. In the joint stage gradients reach it.

    Attributes:
        model: the method itself.
        proxy: stands in for the surface where the host cannot trace it cheaply; `proxy.report()` says how
            well. None: the host traces, or the settings ask for no rays between surfaces.
        light_solver: remembers what steps showed, and solves for the light now and then.
        missing: the optional methods that the host does not have, and what is lost without each.
        step_guard: leaves out steps that are not finite, of optimisers that `guard` has named.
        watch: what was found to be wrong so far; `health()` sums it up.
    """

    def __init__(self, model: NeilfModel, proxy: SurfaceProxy | None = None) -> None:
        super().__init__()
        self.model = model
        self.proxy = proxy
        self.light_solver = model.light_solver()
        self.missing = missing_capabilities(_inner(model.host))
        facts = model.facts
        hit_share = model.config.shading.hit_share
        self.first_look = FirstLook(host_name(model.host), hit_share, facts.response, facts.median_radiance)
        self.step_guard = StepGuard(log.warning)
        self.watch = Watch(None, log.warning)
        self._steps, self._with_material = 0, False
        self._shown: tuple[PixelBatch, SurfaceHits] | None = None
        model.observers.append(self._observe)

    def forward(self, batch: PixelBatch, step: int | Stage | str, hits: Rendered | None = None) -> Total:
        """`losses`, under the name that data-parallel wrappers call."""
        return self.losses(batch, step, hits)

    def losses(self, batch: PixelBatch, step: int | Stage | str, hits: Rendered | None = None) -> Total:
        """The weighted sum of the losses of a step, to add to your own loss, and each term before its weight.

        Args:
            batch: pixels with their rays in the scene frame; see `pixel_batch`.
            step: the number of the step, from 0, which `config.train` places in its stage; or a stage by
                name, "joint" say.
            hits: what the host has rendered of these rays already, in any form that `hosts.answers` reads:
                the rays are then not rendered again. In the joint stage gradients go back through it.

        Raises:
            UserError: the host returned what cannot be used, or the batch cannot be, or is on another device.
        """
        check_batch(batch)
        self._check_place(batch.rays)
        self.first_look.pixels(batch)
        position = self._position(step)
        weights = active_losses(position.stage, self.model.config, self.model.stages, position.share)
        if not weights:
            # A loop without a loss of its own may still call backward.
            return Total(torch.zeros((), device=batch.origins.device, requires_grad=True), {})
        moves_host = self.model.stages[position.stage].moves_host
        computed = self.model(batch, position.stage, self._rendered(batch.rays, hits, moves_host))
        total = weigh(computed.terms, weights)
        if self.training:
            number = self._steps if isinstance(step, str) else int(step)
            self._steps = number + 1
            self.step_guard.begin_step(total.terms, number)
            self._look_after(computed, position, number)
        return total

    def guard(self, optimizer: torch.optim.Optimizer) -> None:
        """Leave out the steps of an optimiser in which a loss of ours or any of its gradients is not finite.
        Each is warned of; ten in a row end the training by `errors.Diverged`, raised by `optimizer.step()`.

        Example:
            >>> neilf.guard(optimizer)                                                     # doctest: +SKIP
        """
        self.step_guard.watch(optimizer)

    def health(self) -> Health:
        """Whether what was learned is sound, by the pixels of the last step (docs/health.md). It renders
        nothing.
        """
        if self._shown is not None:
            batch, hits = self._shown
            on_object = hits[torch.nonzero(batch.mask > 0.5)[:, 0]]
            seen = look_at_hits(self.model, on_object, self._with_material)
            self.watch.judge(seen, self.step_guard.skipped, self._steps)
        return Health.of(self.watch.findings.values())

    def maps(self, rays: RayBatch | Camera, hits: Rendered | None = None) -> Maps:
        """Every map of a view, a row per ray: material, shading, normal, depth (`structures.Maps`).

        Args:
            rays: in the scene frame; bound the memory by their number. Or a camera, of a host that draws
                whole images.
            hits: what the host has rendered of them already.

        Raises:
            UserError: as of `losses`.
        """
        if isinstance(rays, Camera):
            if not isinstance(self.model.host, ForeignHost):
                raise UserError(
                    f"{host_name(self.model.host)} takes rays", "give data.views.camera_rays(camera)"
                )
            with torch.no_grad():
                rays, hits = self.model.host.image_hits(rays, next(self.model.brdf.parameters()))
        self._check_place(rays)
        rendered = self._rendered(rays, hits, moves_host=False)
        if rendered is None:
            return self.model.maps(rays)
        at_once = self.model.config.train.eval_chunk
        starts = range(0, max(len(rays), 1), at_once)
        parts = [self.model.maps(rays[i : i + at_once], hits=rendered[i : i + at_once]) for i in starts]
        return Maps(*(torch.cat([getattr(part, f.name) for part in parts]) for f in fields(Maps)))

    def param_groups(self) -> list[dict[str, Any]]:
        """Groups for `optimizer.add_param_group`, a field each with its learning rate of `config.optimizer`.

        Example:
            >>> for group in neilf.param_groups():
            ...     optimizer.add_param_group(group)
        """
        rates = self.model.config.optimizer
        groups = self.parameter_groups().items()
        return [
            {"params": p, "lr": getattr(rates, name, rates.geometry), "name": name} for name, p in groups if p
        ]

    def parameter_groups(self) -> Mapping[str, list[nn.Parameter]]:
        """The parameters by field, for a learning rate each (`config.optimizer`)."""
        return self.model.parameter_groups()

    def materials(self, x: Float[Tensor, "N 3"]) -> Material:
        """Base colour, roughness and metallic at points of the scene frame."""
        check_points("x", x)
        return self.model.materials(x)

    def incident_light(self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"]) -> Float[Tensor, "N S 3"]:
        """Linear radiance that arrives at x from wi."""
        check_points("x", x)
        check_points("wi", wi, axes=3)
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
        return Shading(
            *(nothing.index_put((rows,), part) for part in (shading.color, shading.diffuse, shading.specular))
        )

    # ------------------------------------------------------------------------------------------ inside a step

    def _look_after(self, computed: StepResult, position: StagePosition, number: int) -> None:
        """What follows a training step: the light, when it is time, and whether all is well."""
        self.light_solver.observe(computed)
        if self.light_solver.due:
            self.watch.after_fit(self.light_solver.points, number)
        self.light_solver.solve(self.model.brdf, self.model.scene)
        plan = self.model.stages[position.stage]
        self._with_material = plan.moves_material
        self.watch.after_step(plan, computed, number)
        if position.step + 1 == position.length:
            self.health()

    def _position(self, step: int | Stage | str) -> StagePosition:
        if not isinstance(step, str):
            if step < 0:
                raise UserError(f"step {step}", "count steps from 0")
            return stage_at(int(step), self.model.config.train)
        names = [stage.value for stage in Stage]
        if step not in names:
            raise UserError(
                f"'{step}' is no stage", f"give the number of the step, or one of {', '.join(names)}"
            )
        return StagePosition(Stage(step), 0, 2)  # a stage without an end

    def _check_place(self, rays: RayBatch) -> None:
        own = next(self.model.brdf.parameters())
        if rays.origins.device != own.device:
            places = f"rays on {rays.origins.device}, material and light on {own.device}"
            raise UserError(places, "move one of them: neilf.to(device)")
        if rays.origins.dtype != own.dtype:
            types = f"rays are {rays.origins.dtype}, material and light {own.dtype}"
            raise UserError(types, "give rays.float(), or compute in the other: neilf.double()")

    def _rendered(self, rays: RayBatch, hits: Rendered | None, moves_host: bool) -> SurfaceHits | None:
        """What the host says of camera rays, where the model is not to ask it; none: it is."""
        host = self.model.host
        if hits is not None:
            return host.read(rays, hits) if isinstance(host, ForeignHost) else as_hits(host, rays, hits)
        if not isinstance(host, ForeignHost) or answers_secondary_rays(host.inner):
            return None
        with torch.set_grad_enabled(torch.is_grad_enabled() and moves_host):
            return host.camera_hits(rays)

    def _observe(self, batch: PixelBatch, hits: SurfaceHits) -> None:
        self.first_look.hits(batch, hits)
        self._shown = batch, hits.detach()
        if isinstance(self.model.host, ForeignHost):
            self.model.host.show_proxy(batch.rays, hits)


def attach_neilf(
    host: Any,
    config: NeilfConfig | None = None,
    *,
    response: str = "linear",
    median_radiance: float = 0.5,
    radiance_scale: float | None = None,
    open_scene: bool = False,
) -> AttachedNeilf:
    """Put the material field, the light and their losses on top of a host. One line of the log says what the
    host lacks, and when its material starts. The global random state stays as it is.

    Args:
        host: an object with `render(rays) -> SurfaceHits`, or `render_image(camera) -> SurfaceHits` where it
            draws whole images; a function (origins, directions) → (color, position, normal); or a nerfstudio
            model. In a frame where the object lies in the unit sphere. docs/hosts.md has a recipe for each.
        config: the settings; none: the preset `fast`, and for a host that belongs to another trainer material
            from step 0.
        response: what the pixels are: "linear" (HDR) or "srgb" (LDR).
        median_radiance: median linear luminance of the object in the images; sets the light's first guess.
        radiance_scale: the range of the host's radiance; none: 3 for HDR, 1 for LDR.
        open_scene: pixels of rays that meet nothing show the light from far away, not a backdrop; a map keeps
            to them.

    Raises:
        UserError: the host is none of these, a fact cannot be right, or the environment map that the settings
            name cannot be used.
    """
    if response not in RADIANCE_SCALE:
        raise UserError(
            f"response '{response}'",
            "choose linear (pixels are radiance) or srgb (8-bit images, divided by 255)",
        )
    scale = RADIANCE_SCALE[response] if radiance_scale is None else radiance_scale
    for name, value in {"median_radiance": median_radiance, "radiance_scale": scale}.items():
        if not 0 < value < math.inf:
            raise UserError(
                f"{name} is {value}",
                "give the median linear luminance of the object, or of the host's largest",
            )
    borrowed = not isinstance(host, HasParameterGroups)
    if config is None:
        config = preset("fast")
        config = replace(config, train=replace(config.train, sdf_steps=0)) if borrowed else config
    adapted = _adapt(host, response)
    facts = SceneFacts(response, median_radiance, scale, "inverted_sphere" if open_scene else "constant")
    with torch.random.fork_rng(range(torch.cuda.device_count()) if torch.cuda.is_initialized() else []):
        proxy = proxy_for(adapted, config)
        whole = adapted if isinstance(adapted, LightsItself) else ForeignHost(adapted, borrowed, proxy)
        attached = AttachedNeilf(NeilfModel(whole, config, facts, borrowed=borrowed), proxy)
    if config.known_map is not None:
        attached.model.light.show(read_environment(Path(config.known_map)))
    log.warning("NeILF++ attached to %s: %s", host_name(adapted), _what_comes(attached, borrowed))
    return attached


def missing_capabilities(host: object) -> Mapping[str, str]:
    """The optional methods that most hosts could have and this one does not, and what is lost without each;
    `hosts.capabilities` has all.
    """
    return {c.method: c.without for c in CAPABILITIES if c.told and not hasattr(host, c.method)}


def pixel_batch(origins: Tensor, directions: Tensor, color: Tensor, mask: Tensor | None = None) -> PixelBatch:
    """Pixels of a loop that knows rays and colours, and perhaps where the object is: 1 on it and 0 off it.

    Raises:
        UserError: something has another shape, or integers.
    """
    for name, rows in {"origins": origins, "directions": directions, "color": color}.items():
        check_rows(name, rows, len(origins), 3)
    if mask is not None:
        check_rows("mask", mask, len(origins))
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


def _what_comes(attached: AttachedNeilf, borrowed: bool) -> str:
    """What a person must know of an attachment, in one line."""
    train = attached.model.config.train
    parts = []
    if borrowed:
        start = train.sdf_steps
        parts += (
            [f"nothing is computed before step {start} (train.sdf_steps)"]
            if start
            else ["material from step 0"]
        )
        parts += (
            [f"the host moves with it from step {start + train.material_steps}"] if train.joint_steps else []
        )
    if attached.proxy is not None:
        parts += [
            "a proxy of its surface, gathered from the training rays, traces the light between surfaces"
        ]
    parts += [f"no {name}: {loss}" for name, loss in attached.missing.items()]
    return "; ".join(parts) or "it has all that a host can have"


def _inner(host: object) -> object:
    return host.inner if isinstance(host, ForeignHost) else host


def _adapt(host: object, response: str) -> Host | ImageHost:
    if isinstance(host, nn.Module) and hasattr(host, "get_outputs") and hasattr(host, "config"):
        from neilfpp_method.hosts.nerfstudio import NerfstudioHost

        return NerfstudioHost(host, response=response)
    if isinstance(host, Host | ImageHost):
        return host
    if callable(host):
        return CallableHost(host)
    raise UserError(
        f"{type(host).__name__} is no host",
        "give an object with render(rays) or render_image(camera), or a function of (origins, directions)",
    )
