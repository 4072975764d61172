"""`NeilfModel` as a nerfstudio model, with the losses, stages and rates of the standalone loop."""

from __future__ import annotations

import dataclasses
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any, Optional

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.engine.optimizers import OptimizerConfig, Optimizers
from nerfstudio.engine.trainer import Trainer
from nerfstudio.models.base_model import Model, ModelConfig
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor, nn

from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.effects.first_light import start_with
from neilfpp_method.effects.places.search import is_search_due
from neilfpp_method.effects.plan import Plan
from neilfpp_method.effects.request import EffectRequest
from neilfpp_method.effects.review import improve_material, light_places, review_light
from neilfpp_method.errors import UserError
from neilfpp_method.health.guard import StepGuard
from neilfpp_method.health.watch import CHECKED_PIXELS, Watch
from neilfpp_method.hosts.foreign import ForeignHost, proxy_for
from neilfpp_method.hosts.nerfstudio import OWN_LOSSES, NerfstudioHost
from neilfpp_method.hosts.proxy import SurfaceProxy
from neilfpp_method.kernels.process import computing_fast
from neilfpp_method.lighting.fit import Evidence
from neilfpp_method.model import NeilfModel
from neilfpp_method.plugin.datamanager import PIXELS, to_pixel_batch
from neilfpp_method.plugin.foreign import build_foreign
from neilfpp_method.plugin.outputs import method_outputs
from neilfpp_method.plugin.pictures import material_pictures, view_figures, view_pictures
from neilfpp_method.plugin.record import RunRecord, no_record
from neilfpp_method.schedule import Stage, active_losses, has_material, stage_at, total_steps, weigh
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.presets import preset
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.structures import RayBatch, StepResult
from neilfpp_method.train.build import build_model, scene_facts, show_known_light
from neilfpp_method.train.health_record import write_findings
from neilfpp_method.train.optimizer import (
    Stream,
    adam,
    limit_surface_width,
    seed_step,
    seed_stream,
    set_rates,
    waiting_fields,
)
from neilfpp_method.train.skipped import Moment
from neilfpp_method.train.vanished import restore_surface

__all__ = ["FieldAdamConfig", "NeilfMethod", "NeilfMethodConfig"]


@dataclass
class FieldAdamConfig(OptimizerConfig):
    """The optimizer of one field. Its learning rate is set in each step, as in the standalone loop."""

    name: str = ""
    """Name of the field."""

    def setup(self, params: list[nn.Parameter]) -> torch.optim.Optimizer:
        """Adam, as in `train.optimizer.make_optimizer`."""
        return adam([{"params": params, "name": self.name, "lr": self.lr}])


@dataclass
class NeilfMethodConfig(ModelConfig):
    """NeILF++ on a host."""

    _target: type = field(default_factory=lambda: NeilfMethod)
    enable_collider: bool = False
    """Unused, because hosts limit their rays themselves."""
    host: Optional[str] = None  # noqa: UP045  (tyro reads it at run time)
    """A nerfstudio method that renders rays (neus, nerfacto, …), to use as the host; default: the host of
    `neilf`. It is trained with its own learning rate and regularisers.
    """
    host_losses: float = 1.0
    """Weight of the regularisers of `host`. With 0 they are replaced by L_Eik if it is a surface model."""
    neilf: NeilfConfig = field(default_factory=lambda: preset("fast"))
    """The settings of the method. Of `train`, only the seed and the steps of the stages are used;
    nerfstudio's own camera optimizer can correct poses.
    """


class NeilfMethod(Model):
    """The method as a nerfstudio model, which runs the three stages through nerfstudio's callbacks.

    The outputs `rgb` and `rgb_volume` are in the response of the capture: linear for HDR captures.

    Attributes:
        neilf: the method, on its own host or on a nerfstudio model.
        rates: the learning rates.
        proxy: the surface on which rays are traced for a nerfstudio model; None if none is needed.
        pixels: the training pixels.
        light_solver: finds the environment map and the lamps between steps.
        watch: the findings of the health checks.
        guard: skips steps that are not finite.
        moment: the state before the current step, with which it can be repeated; None before training.
        record: writes the run folder; None before training, and if no folder can be written.
        computed: what the last step computed, until the light is solved; None otherwise.
        evidence: the evidence for lamps of the last fit that decided about them; None if none has.
        step: number of the current or last step; -1 before training.
        set_up_for: the stage for which fields are frozen; None before the first step.
        while_training: holds the process-wide settings of training, and restores the former ones at its end.
    """

    config: NeilfMethodConfig
    neilf: NeilfModel

    def populate_modules(self) -> None:
        """Build the model for the capture that the data manager has read."""
        super().populate_modules()
        pixels: PixelDataset | None = self.kwargs["metadata"].get(PIXELS)
        if pixels is None:
            raise UserError(
                "the data manager is not that of neilfpp",
                "leave --pipeline.datamanager as `ns-train neilfpp` sets it",
            )
        settings = self.config.neilf
        self.proxy: SurfaceProxy | None = None
        facts = scene_facts(pixels.capture, pixels, settings)
        seed_stream(settings.train.seed, Stream.WEIGHTS)
        self.rates = settings.optimizer
        if self.config.host is None:
            self.neilf = build_model(pixels.capture, facts, settings)
        else:
            self._build_on(self.config.host, facts)
        self.pixels = pixels
        self.light_solver = self.neilf.light_solver()
        seed_stream(settings.train.seed, Stream.HEALTH)
        self.watch = Watch(pixels.sample(CHECKED_PIXELS, gradients=False), CONSOLE.log)
        self.guard = StepGuard(self._report_skipped)
        self.moment: Moment | None = None
        self.record: RunRecord | None = None
        self.computed: StepResult | None = None
        self.evidence: Evidence | None = None
        self.step = -1
        self.set_up_for: Stage | None = None
        self.while_training = ExitStack()

    def _build_on(self, name: str, facts: SceneFacts) -> None:
        """Build the model on top of a nerfstudio method, with a proxy if that cannot trace rays cheaply."""
        settings = self.config.neilf
        arguments = {"scene_box": self.scene_box, "num_train_data": self.num_train_data, **self.kwargs}
        foreign = build_foreign(name, arguments)
        self.rates = dataclasses.replace(settings.optimizer, geometry=foreign.rate)
        host = NerfstudioHost(
            foreign.model,
            response=facts.response,
            radiance_scale=facts.radiance_scale,
            own_losses=self.config.host_losses > 0.0,
        )
        self.proxy = proxy_for(host, settings)
        foreign_host = ForeignHost(host, borrowed=False, proxy=self.proxy)
        self.neilf = NeilfModel(foreign_host, settings, facts)
        self.neilf.observers.append(lambda batch, hits: foreign_host.update_proxy(batch.rays, hits))
        if self.proxy is not None:
            CONSOLE.log(
                f"{name} cannot trace rays cheaply: shadows and inter-reflection are traced on a proxy of "
                "its surface that is built from the training rays"
            )

    @property
    def stage(self) -> Stage:
        """The stage of the current or last step; the first stage before training."""
        return stage_at(self.step, self.config.neilf.train).stage

    def get_param_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by field."""
        return {name: parameters for name, parameters in self.neilf.parameter_groups().items() if parameters}

    # ------------------------------------------------------------------------------------------------- stages

    def get_training_callbacks(
        self, training_callback_attributes: TrainingCallbackAttributes
    ) -> list[TrainingCallback]:
        """The callbacks of this method, and those of a nerfstudio host.

        Raises:
            UserError: if the known environment map cannot be read, or if there are several devices: the
                losses are computed outside of the method that nerfstudio's data-parallel wrapper handles.
        """
        trainer, optimizers = training_callback_attributes.trainer, training_callback_attributes.optimizers
        if trainer.world_size > 1:
            raise UserError(
                "several devices under nerfstudio", "use `neilfpp train --devices N`, or one device"
            )
        # A loaded checkpoint already contains the map.
        if self.step < 0:
            show_known_light(self.neilf)
        of_host = (
            self.neilf.host.inner.model.get_training_callbacks(training_callback_attributes)
            if isinstance(self.neilf.host, ForeignHost)
            else []
        )
        for optimizer in optimizers.optimizers.values():
            self.guard.watch(optimizer)
        obstacle = no_record(trainer, self.config.host)
        if obstacle:
            CONSOLE.log(f"no run folder for the neilfpp commands: {obstacle}")
        else:
            self.record = RunRecord.of(trainer, self.config.neilf, self.neilf.facts)
        before = [TrainingCallbackLocation.BEFORE_TRAIN_ITERATION]
        after = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
        return [
            *of_host,
            TrainingCallback(before, self._begin_step, args=[optimizers]),
            TrainingCallback(after, self._solve_light),
            TrainingCallback(after, self._check_and_save, args=[trainer]),
            TrainingCallback(after, self._end_after_last, args=[trainer]),
            TrainingCallback(
                [TrainingCallbackLocation.AFTER_TRAIN], lambda step: self.while_training.close()
            ),
        ]

    def _begin_step(self, optimizers: Optimizers, step: int) -> None:
        """Set up the stage if it is new, then the learning rates and the random numbers of the step."""
        settings = self.config.neilf.train
        self.step = step
        position = stage_at(step, settings)
        if self.set_up_for is None:
            # `neilfpp train` computes with flushed denormal numbers: ten times as fast, and other roundings.
            self.while_training.enter_context(computing_fast())
        if self.set_up_for is not position.stage:
            if self.neilf.stages[position.stage].trains_material and self.light_solver.seeks_start:
                self._start_light(step)
            self.neilf.freeze_for(position.stage)
            self.set_up_for = position.stage
        waiting = waiting_fields(self.neilf, self.rates, position)
        for optimizer in optimizers.optimizers.values():
            set_rates(optimizer, self.rates, position, waiting)
        seed_step(settings.seed, step)

    def _start_light(self, step: int) -> None:
        """Set the initial light before material is trained, as in the standalone loop."""
        settings = self.config.neilf
        seed_stream(settings.train.seed, Stream.LIGHT, step)
        plan, pixels = Plan.begin(EffectRequest("as-set"), settings), self.pixels.on(self.device)
        first = review_light(plan, self.neilf, pixels, step).first
        if first is not None:
            CONSOLE.log(first.summary())
            start_with(self.neilf, self.light_solver, first)

    def _solve_light(self, step: int) -> None:
        """Bound β, solve for the light and search the material if due, after the optimizer's step."""
        settings = self.config.neilf
        limit_surface_width(self.neilf.host, settings.volume, stage_at(step, settings.train))
        if restore_surface(self.neilf.host, stage_at(step + 1, settings.train)):
            CONSOLE.log(f"step {step + 1}: the surface had vanished and is restored")
        if self.computed is None:
            return
        self.light_solver.observe(self.computed)
        self.watch.after_step(self.neilf.stages[self.stage], self.computed, step)
        if self.light_solver.due:
            self.watch.after_fit(self.light_solver.points, step)
        self.evidence = self.light_solver.solve(self.neilf.brdf, self.neilf.scene) or self.evidence
        self._search_material(step)
        self.computed = None

    def _search_material(self, step: int) -> None:
        """Search for paint taken for metal when this is due, as in the standalone loop."""
        position = stage_at(step, self.config.neilf.train)
        if not is_search_due(self.neilf, dataclasses.replace(position, step=position.step + 1)):
            return
        seed_stream(self.config.neilf.train.seed, Stream.SEARCH, step + 1)
        summary = improve_material(self.neilf, light_places(self.neilf, self.pixels.on(self.device)))
        if summary is not None:
            CONSOLE.log(summary)

    def _check_and_save(self, trainer: Trainer, step: int) -> None:
        """Check the health at the end of a stage; write the run folder then and when nerfstudio saves."""
        done = step + 1
        position = stage_at(step, self.config.neilf.train)
        ends = position.step + 1 == position.length
        if ends:
            self.watch.pixels = self.watch.pixels.to(self.device)
            self.watch.after_stage(self.neilf, self.neilf.stages[position.stage], self.guard.skipped, done)
            CONSOLE.log(f"health after {position.stage.value}: {self.watch.health}")
            if self.proxy is not None and self.proxy.report() is not None:
                CONSOLE.log(str(self.proxy.report()))
        # The condition under which nerfstudio saves.
        saves = step > 0 and step % trainer.config.steps_per_save == 0
        if ends or saves or done == trainer._start_step + trainer.config.max_num_iterations:
            write_findings(trainer.base_dir, self.watch)
            if self.record is not None:
                self.record.save(self.neilf, self.light_solver, self.watch, trainer, done)

    def _end_after_last(self, trainer: Trainer, step: int) -> None:
        """Stop after the last stage: nerfstudio counts iterations from the step at which it resumes."""
        if step + 1 >= total_steps(self.config.neilf.train):
            trainer.stop_training = True

    def update_to_step(self, step: int) -> None:
        """Set the step after a checkpoint has been loaded."""
        self.step = step

    # ------------------------------------------------------------------------------------------------- losses

    def get_loss_dict(
        self, outputs: dict[str, Tensor], batch: dict[str, Any], metrics_dict: dict[str, Tensor] | None = None
    ) -> dict[str, Tensor]:
        """The weighted losses of the stage; in evaluation mode the mean absolute error of the image."""
        if not self.training:
            return {"rgb": (outputs["rgb"] - batch["image"].to(self.device)).abs().mean()}
        pixels = to_pixel_batch(outputs["origins"], outputs["directions"], batch)
        position = stage_at(self.step, self.config.neilf.train)
        self.moment = Moment.before_step(self.neilf, pixels, position, self.step)
        computed = self.neilf.step(pixels, position.stage)
        terms = computed.terms
        self.computed = computed
        weights = {
            **active_losses(position.stage, self.neilf.config, self.neilf.stages, position.share),
            OWN_LOSSES: self.config.host_losses,
        }
        total = weigh(terms, weights)
        self.guard.begin_step(total.terms, self.step)
        if metrics_dict is not None:
            # Nerfstudio logs the metrics after this call, so the unweighted terms can be added here.
            metrics_dict |= total.terms | self._light_found()
        return {name: weigh({name: term}, weights).loss for name, term in terms.items()}

    def _report_skipped(self, text: str) -> None:
        """Log a step that was not finite, and store it in the run folder if there is one."""
        if self.record is not None and self.moment is not None:
            text += self.record.keep_skipped(self.neilf, self.moment)
        CONSOLE.log(text)

    def _light_found(self) -> dict[str, Tensor]:
        """The evidence for lamps of the last fit, unless the settings decide about lamps."""
        if self.evidence is None:
            return {}
        return {
            "lamp_gain": torch.tensor(self.evidence.gain),
            "lamps": torch.tensor(float(self.neilf.lamps.count)),
        }

    # ------------------------------------------------------------------------------------------------ outputs

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Tensor]:
        """All maps in evaluation mode; in training only the rays, since the losses render what they need."""
        rays = RayBatch(ray_bundle.origins, ray_bundle.directions)
        if self.training:
            return {"origins": rays.origins, "directions": rays.directions}
        # Before material is trained, its initial values are not shown.
        maps = self.neilf.maps(rays) if self._has_material() else self.neilf.host_maps(rays)
        return method_outputs(self.neilf, rays, maps)

    def _has_material(self) -> bool:
        return has_material(self.step + 1, self.config.neilf.train)

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Figures of a view, as in `neilfpp eval`, and pictures of its maps, for nerfstudio's log."""
        batch = {key: value.to(self.device) for key, value in batch.items() if isinstance(value, Tensor)}
        response = self.neilf.facts.response
        pictures = view_pictures(outputs, batch, response)
        if self._has_material():
            pictures |= material_pictures(outputs)
        return view_figures(outputs, batch, response), pictures
