"""`attach_neilf`: add material and light to another system's geometry and radiance, in its training loop.

It takes three lines, the last of them in every training step:

    neilf = attach_neilf(host)
    for group in neilf.param_groups(): optimizer.add_param_group(group)
    loss = loss + neilf.losses(batch, step).loss
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from neilfpp_method.data.cameras.camera import Camera
from neilfpp_method.data.files.environment_map import read_environment
from neilfpp_method.effects.places.solver import PlaceSolver
from neilfpp_method.effects.plan import Plan
from neilfpp_method.effects.request import check_effects, parse_effects
from neilfpp_method.errors import UserError
from neilfpp_method.health.cases import Health
from neilfpp_method.health.guard import StepGuard
from neilfpp_method.health.measure import measure_hits
from neilfpp_method.health.watch import Watch
from neilfpp_method.hosts.adapt import adapt, check_parameter_groups
from neilfpp_method.hosts.base import HasParameterGroups, TracesLight
from neilfpp_method.hosts.batches import check_batch, check_like, check_points, check_step, pixel_batch
from neilfpp_method.hosts.capabilities import missing_capabilities
from neilfpp_method.hosts.conversion import Rendered, as_hits
from neilfpp_method.hosts.first_batches import FirstBatches
from neilfpp_method.hosts.foreign import ForeignHost, answers_secondary_rays, proxy_for
from neilfpp_method.hosts.image import rays_like
from neilfpp_method.hosts.outputs import host_name
from neilfpp_method.hosts.proxy import SurfaceProxy
from neilfpp_method.model import EVAL_RAYS, NeilfModel
from neilfpp_method.schedule import Stage, StagePosition, Total, active_losses, learning_rate, stage_at, weigh
from neilfpp_method.settings.facts import stated_facts
from neilfpp_method.settings.presets import preset
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.structures import Maps, Material, PixelBatch, RayBatch, Shading, StepResult, SurfaceHits

__all__ = ["AttachedNeilf", "attach_neilf", "pixel_batch"]

log = logging.getLogger(__name__)


class AttachedNeilf(nn.Module):
    """Material and light of a scene whose geometry and radiance come from a host. Made by `attach_neilf`.

    A host with `parameter_groups` is trained together with material and light: `parameters()` includes its
    parameters, and all three stages of the paper run. Every other host is borrowed: `parameters()`,
    `state_dict()`, `to()` and `train()` do not include it, and nothing is computed in the first stage, for
    which its own trainer is responsible. A borrowed host is rendered without gradients in the material stage
    and with gradients in the joint stage.

    Attributes:
        model: the method itself.
        proxy: traces rays between surfaces if the host cannot do it cheaply; `proxy.report()` measures its
            error. None if the host traces these rays itself, or if the settings trace no rays.
        light_solver: stores surface points of the training steps and solves for the light at intervals.
        places: stores more of them, decides on effects, finds an initial light, and searches for paint at
            which training is stuck.
        plan: the effects that are simulated, and why (docs/effects.md); `effects.table.effects_table` draws
            it.
        missing: the optional methods that the host does not have, and the consequence of each.
        step_guard: skips steps of guarded optimizers (`guard`) whose losses or gradients are not finite.
        watch: problems found so far; `health()` summarises them.
    """

    def __init__(self, model: NeilfModel, plan: Plan, proxy: SurfaceProxy | None = None) -> None:
        super().__init__()
        self.model, self.plan, self.proxy = model, plan, proxy
        self.light_solver = model.light_solver()
        self.places = PlaceSolver(plan, model.facts.response, log.warning)
        self.missing = missing_capabilities(_inner(model.host))
        host, config, facts = model.host, model.config, model.facts
        # Only tracing light between surfaces needs a host that renders rays from any viewpoint.
        renders_secondary_rays = (
            model.borrowed and config.light.inter_reflection != "off" and answers_secondary_rays(_inner(host))
        )
        render = host.render if renders_secondary_rays else None
        self.first_batches = FirstBatches(
            host_name(host), config.shading.hit_share, facts, render, traced_by_host=proxy is None
        )
        self.step_guard = StepGuard(log.warning)
        self.watch = Watch(None, log.warning, log.info)
        self._steps, self._with_material = 0, False
        self._last_rendered: tuple[PixelBatch, SurfaceHits] | None = None
        model.observers.append(self._observe)

    def forward(self, batch: PixelBatch, step: int | Stage | str, hits: Rendered | None = None) -> Total:
        """Alias of `losses`: the wrappers of data-parallel training call `forward`."""
        return self.losses(batch, step, hits)

    # The number of hits changes in every step, and some steps fit the light by an optimisation of their own.
    # `torch.compile` would trace all of it again and again, for minutes and into many small graphs.
    @torch.compiler.disable
    def losses(self, batch: PixelBatch, step: int | Stage | str, hits: Rendered | None = None) -> Total:
        """Compute the losses of a training step; add `.loss` to the loss of your loop.

        In training mode this also updates the light solver and the health checks.

        Args:
            batch: pixels with their rays in the scene frame; see `pixel_batch`.
            step: index of the step, counted from 0, from which `config.train` determines the stage; or the
                name of a stage, for example "joint".
            hits: what the host rendered for these rays, in any form that `hosts.conversion` reads; if None,
                the host is rendered here. In the joint stage gradients flow back through it.

        Returns:
            The weighted sum of the losses, and each term before its weight.

        Raises:
            UserError: the batch or the output of the host is invalid, or on another device.
        """
        check_batch(batch)
        check_step(step)
        self._check_device_and_dtype("rays", batch.origins)
        self.first_batches.pixels(batch)
        position = self._position(step)
        weights = active_losses(position.stage, self.model.config, self.model.stages, position.share)
        if not weights:
            # A zero that requires a gradient: a loop without a loss of its own may still call backward.
            return Total(torch.zeros((), device=batch.origins.device, requires_grad=True), {})
        plan = self.model.stages[position.stage]
        number = self._steps if isinstance(step, str) else int(step)
        if self.training and plan.trains_material:
            self.places.before_step(self.model, self.light_solver, position, number)
        result = self.model(batch, position.stage, self._host_hits(batch.rays, hits, plan.trains_host))
        total = weigh(result.terms, weights)
        if self.training:
            self._steps = number + 1
            self.step_guard.begin_step(total.terms, number)
            self._after_step(result, position, number)
        return total

    def guard(self, optimizer: torch.optim.Optimizer) -> None:
        """Skip steps of an optimizer in which a NeILF++ loss or one of its gradients is not finite.

        Each skipped step logs a warning. After ten in a row `optimizer.step()` raises `errors.Diverged`.

        Example:
            >>> neilf.guard(optimizer)                                                     # doctest: +SKIP
        """
        self.step_guard.watch(optimizer)

    def health(self) -> Health:
        """Judge the result by the pixels of the last step (docs/health.md), without rendering anything."""
        if self._last_rendered is not None:
            batch, hits = self._last_rendered
            on_object = hits[torch.nonzero(batch.mask > 0.5)[:, 0]]
            measured = measure_hits(self.model, on_object, self._with_material)
            self.watch.judge(measured, self.step_guard.skipped, self._steps)
        return self.watch.health

    @torch.compiler.disable
    def maps(self, rays: RayBatch | Camera, hits: Rendered | None = None) -> Maps:
        """Render all maps of a view, one row per ray: material, shading, normal, depth (`structures.Maps`).

        Args:
            rays: rays in the scene frame; or a camera, if the host draws whole images. Memory grows with the
                number of rays.
            hits: what the host rendered for these rays; if None, the host is rendered here.

        Raises:
            UserError: as in `losses`.
        """
        if torch.is_inference_mode_enabled():
            # Many hosts compute normals by autograd, which inference mode forbids.
            with torch.inference_mode(False), torch.no_grad():
                return self.maps(rays if isinstance(rays, Camera) else _cloned(rays), hits)
        if isinstance(rays, Camera):
            if not isinstance(self.model.host, ForeignHost):
                raise UserError(
                    f"{host_name(self.model.host)} takes rays", "give data.projection.camera_rays(camera)"
                )
            camera, rays = rays, rays_like(rays, next(self.model.brdf.parameters()))
            with torch.no_grad():
                hits = self.model.host.image_hits(camera, rays)
        self._check_device_and_dtype("rays", rays.origins)
        rendered = self._host_hits(rays, hits, trains_host=False)
        if rendered is None:
            return self.model.maps(rays)
        starts = range(0, max(len(rays), 1), EVAL_RAYS)
        parts = [self.model.maps(rays[i : i + EVAL_RAYS], rendered[i : i + EVAL_RAYS]) for i in starts]
        return Maps.joined(parts)

    def param_groups(self) -> list[dict[str, Any]]:
        """Groups for `optimizer.add_param_group`, one per field, with the learning rates of the settings.

        Example:
            >>> for group in neilf.param_groups():
            ...     optimizer.add_param_group(group)
        """
        rates = self.model.config.optimizer
        groups = self.parameter_groups().items()
        return [{"params": p, "lr": learning_rate(rates, name), "name": name} for name, p in groups if p]

    def parameter_groups(self) -> Mapping[str, list[nn.Parameter]]:
        """The parameters by field."""
        return self.model.parameter_groups()

    def materials(self, x: Float[Tensor, "N 3"]) -> Material:
        """Base colour, roughness and metallic at points of the scene frame."""
        check_points("x", x)
        self._check_device_and_dtype("x", x)
        return self.model.materials(x)

    def incident_light(self, x: Float[Tensor, "N 3"], wi: Float[Tensor, "N S 3"]) -> Float[Tensor, "N S 3"]:
        """Linear radiance that arrives at surface points x from directions wi."""
        check_points("x", x)
        check_points("wi", wi, axes=3)
        self._check_device_and_dtype("x", x)
        self._check_device_and_dtype("wi", wi)
        return self.model.incident_light(x, wi)

    @torch.compiler.disable
    def shade(self, hits: SurfaceHits, wo: Float[Tensor, "N 3"]) -> Shading:
        """Outgoing radiance of hits towards wo by the rendering equation; 0 for rays without a hit."""
        settings = self.model.config.shading
        rows = torch.nonzero(hits.is_hit(settings.hit_share))[:, 0]
        position = hits.position[rows]
        samples = settings.train_samples if self.training else settings.eval_samples
        normal = self.model.shading_normals(position, hits.normal[rows])
        shading = self.model.shade(position, normal, wo[rows], self.materials(position), samples)
        black = torch.zeros_like(wo)
        return Shading(
            *(black.index_put((rows,), part) for part in (shading.color, shading.diffuse, shading.specular))
        )

    def get_extra_state(self) -> dict[str, Any]:
        """The decisions on effects, as plain values for checkpoints."""
        return {"decisions": self.plan.stored()}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore what `get_extra_state` returned, and use the settings that follow from it."""
        self.plan.restore(state["decisions"], "checkpoint")
        self.model.use(self.plan.config)
        self.light_solver.use(self.plan.config.light, self.model.lobe)

    # ------------------------------------------------------------------------------------------ inside a step

    def _after_step(self, result: StepResult, position: StagePosition, number: int) -> None:
        """Solve for the light if that is due, and check the health of the training."""
        plan = self.model.stages[position.stage]
        if plan.trains_material:
            self.places.observe(result.surface)
        self.light_solver.observe(result)
        if not self.places.is_waiting(self.light_solver):
            if self.light_solver.due:
                self.watch.after_fit(self.light_solver.points, number)
            evidence = self.light_solver.solve(self.model.brdf, self.model.scene)
            self.places.after_fit(self.model, self.light_solver, evidence, number)
        self._with_material = plan.trains_material
        self.watch.after_step(plan, result, number)
        if position.step + 1 == position.length:
            self.health()

    def _position(self, step: int | Stage | str) -> StagePosition:
        """The position of a step in its stage, for the index of the step or the name of the stage."""
        if isinstance(step, str):
            # Only the stage is known. Step 0 of 2 is not the last step, at which the health is judged.
            return StagePosition(Stage(step), 0, 2)
        return stage_at(int(step), self.model.config.train)

    def _check_device_and_dtype(self, name: str, value: Tensor) -> None:
        check_like(name, value, next(self.model.brdf.parameters()))

    def _host_hits(self, rays: RayBatch, hits: Rendered | None, trains_host: bool) -> SurfaceHits | None:
        """The host's hits of camera rays, given or rendered; None if the model renders the host itself.

        A host that answers camera rays only is rendered here, because its `render` uses the proxy.
        """
        host = self.model.host
        if hits is not None:
            return host.read(rays, hits) if isinstance(host, ForeignHost) else as_hits(host, rays, hits)
        if not isinstance(host, ForeignHost) or answers_secondary_rays(host.inner):
            return None
        with torch.set_grad_enabled(torch.is_grad_enabled() and trains_host):
            return host.camera_hits(rays)

    def _observe(self, batch: PixelBatch, hits: SurfaceHits) -> None:
        """Check the hits of a training step, keep them for `health`, and add them to the proxy."""
        if len(batch) == 0:
            return
        self.first_batches.hits(batch, hits)
        self._last_rendered = batch, hits.detach()
        # A proxy only traces rays between surfaces.
        if isinstance(self.model.host, ForeignHost) and self.model.config.light.inter_reflection != "off":
            self.model.host.update_proxy(batch.rays, hits)


def attach_neilf(
    host: Any,
    config: NeilfConfig | str = "fast",
    *,
    effects: str = "auto",
    response: str = "linear",
    median_radiance: float = 0.5,
    radiance_scale: float | None = None,
    open_scene: bool = False,
) -> AttachedNeilf:
    """Put the material field, the light and their losses on top of a host.

    One log line names the optional methods that the host lacks and the step at which its material starts. The
    parts are on the device of the host's parameters. The global random state is not changed.

    Args:
        host: an object with `render(rays) -> SurfaceHits`; an object with `render_image(camera) ->
            SurfaceHits` that draws whole images; a function (origins, directions) → (color, position,
            normal); or a nerfstudio model. The object must lie in the unit sphere of the host's frame.
            docs/hosts.md has a recipe for each.
        config: the settings, or the name of a preset. A preset is used without its first stage for a
            borrowed host (one without `parameter_groups`), so that the material starts at step 0.
        effects: the effects to simulate, as `neilfpp train --effects` takes them: "auto" decides by evidence
            as soon as enough surface points are known, "as-set" leaves them as they are in the settings.
        response: meaning of pixel values: "linear" (HDR) or "srgb" (LDR).
        median_radiance: median linear luminance of the object in the images; sets the initial light.
        radiance_scale: largest radiance of the host; if None, 3 for HDR and 1 for LDR.
        open_scene: whether pixels of rays that miss the scene show the distant light; an environment map is
            then fitted to these pixels as well. False if they show a backdrop.

    Returns:
        A module with the losses, maps and parameters of material and light.

    Raises:
        UserError: the host has none of these forms or takes other arguments, no preset or effect has this
            name, an argument is out of range, or the environment map that the settings name cannot be used.
    """
    facts = stated_facts(response, median_radiance, radiance_scale, open_scene)
    adapted = adapt(host, response)
    borrowed = not isinstance(host, HasParameterGroups)
    if not borrowed:
        check_parameter_groups(host)
    if isinstance(config, str):
        config = preset(config)
        config = replace(config, train=replace(config.train, sdf_steps=0)) if borrowed else config
    if not isinstance(config, NeilfConfig):
        raise UserError(
            f"config is a {type(config).__name__}", "give a NeilfConfig, or the name of a preset, as 'fast'"
        )
    request = parse_effects(effects)
    check_effects(request, config)
    plan = Plan.begin(request, config)
    config = plan.config_of_model
    devices = range(torch.cuda.device_count()) if torch.cuda.is_initialized() else []
    # Parameters that are made in inference mode could never be trained.
    with torch.inference_mode(False), torch.random.fork_rng(devices):
        proxy = proxy_for(adapted, config)
        complete = adapted if isinstance(adapted, TracesLight) else ForeignHost(adapted, borrowed, proxy)
        attached = AttachedNeilf(NeilfModel(complete, config, facts, borrowed=borrowed), plan, proxy)
    if config.known_map is not None:
        attached.model.light.show(read_environment(Path(config.known_map)))
    attached.to(_device_of(host))
    log.warning("NeILF++ attached to %s: %s", host_name(adapted), _attachment_summary(attached, borrowed))
    return attached


def _device_of(host: Any) -> torch.device:
    """The device of the host's first parameter; the default device if it has none."""
    parameters = host.parameters() if isinstance(host, nn.Module) else iter(())
    return next((p.device for p in parameters), torch.get_default_device())


def _attachment_summary(attached: AttachedNeilf, borrowed: bool) -> str:
    """One line for the log: when training of the material starts, the proxy, and missing capabilities."""
    train, parts = attached.model.config.train, []
    if borrowed and train.sdf_steps:
        parts.append(f"nothing is computed before step {train.sdf_steps} (train.sdf_steps)")
    elif borrowed:
        parts.append("the material is trained from step 0")
    if borrowed and train.joint_steps:
        parts.append(f"the host gets gradients from step {train.sdf_steps + train.material_steps}")
    if attached.proxy is not None:
        parts.append("a proxy of its surface, built from the training rays, traces light between surfaces")
    parts += [f"no {method}: {consequence}" for method, consequence in attached.missing.items()]
    return "; ".join(parts) or "it has all optional methods"


def _cloned(rays: RayBatch) -> RayBatch:
    """Copies of rays that are not inference tensors, so that a host may compute gradients with them."""
    return rays.map(torch.Tensor.clone)


def _inner(host: object) -> object:
    return host.inner if isinstance(host, ForeignHost) else host
