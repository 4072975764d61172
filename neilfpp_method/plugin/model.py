"""`NeilfModel` as a nerfstudio model, with the losses, stages and rates of the standalone loop."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any, Optional

import torch
from nerfstudio.cameras.rays import RayBundle
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackAttributes, TrainingCallbackLocation
from nerfstudio.engine.optimizers import OptimizerConfig
from nerfstudio.models.base_model import Model, ModelConfig
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor, nn

from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.effects.plan import Plan
from neilfpp_method.effects.review import record_facts
from neilfpp_method.errors import UserError
from neilfpp_method.hosts.foreign import ForeignHost, proxy_for
from neilfpp_method.hosts.nerfstudio import OWN_LOSSES, NerfstudioHost
from neilfpp_method.hosts.proxy import SurfaceProxy
from neilfpp_method.model import NeilfModel
from neilfpp_method.plugin.datamanager import PIXELS, to_pixel_batch
from neilfpp_method.plugin.effects import begin_plan, restore_decisions, stored_decisions
from neilfpp_method.plugin.exporting import DistanceField, stored_colors
from neilfpp_method.plugin.foreign import build_foreign, has_distance_field
from neilfpp_method.plugin.outputs import method_outputs
from neilfpp_method.plugin.pictures import material_pictures, view_figures, view_pictures
from neilfpp_method.plugin.record import RunRecord, no_record
from neilfpp_method.plugin.steps import Steps
from neilfpp_method.schedule import Stage, active_losses, weigh
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.presets import preset
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.structures import PixelBatch, RayBatch, SurfaceHits
from neilfpp_method.train.build import build_model, measure_facts, show_known_light
from neilfpp_method.train.optimizer import Stream, adam, seed_stream

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
    effects: str = "auto"
    """The effects to simulate, as `neilfpp train --effects` takes them, for example auto,-lamps. With auto,
    evidence decides; with as-set, the settings do.
    """
    neilf: NeilfConfig = field(default_factory=lambda: preset("fast"))
    """The settings of the method. Of `train`, only the seed and the steps of the stages are used;
    nerfstudio's own camera optimizer can correct poses.
    """

    @property
    def sdf_field(self) -> str:
        """The host, if it has a distance field. `ns-export marching-cubes` asks whether this exists.

        Raises:
            AttributeError: if it has none.
        """
        if self.neilf.host.kind == "volsdf" if self.host is None else has_distance_field(self.host):
            return self.host or self.neilf.host.kind
        raise AttributeError("the host has no distance field")


class NeilfMethod(Model):
    """The method as a nerfstudio model, which runs the three stages through nerfstudio's callbacks.

    The outputs `rgb` and `rgb_volume` are in the response of the capture: linear for HDR captures.

    Attributes:
        plan: the effects that are simulated, and why.
        neilf: the method, on its own host or on a nerfstudio model.
        rates: the learning rates.
        proxy: the surface on which rays are traced for a nerfstudio model; None if none is needed.
        light_solver: finds the environment map and the lamps between steps.
        steps: the work before and after each step of the trainer.
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
        self.plan: Plan = begin_plan(self.config.effects, self.config.neilf)
        self.proxy: SurfaceProxy | None = None
        facts = measure_facts(self.plan, pixels.capture, pixels)
        record_facts(self.plan, facts)
        settings = self.plan.config_of_model
        seed_stream(settings.train.seed, Stream.WEIGHTS)
        self.rates = settings.optimizer
        if self.config.host is None:
            self.neilf = build_model(pixels.capture, facts, settings)
        else:
            self._build_on(self.config.host, facts, settings)
        # A submodule, so that nerfstudio's checkpoints contain it.
        self.light_solver = self.neilf.light_solver()
        self.steps = Steps(self.neilf, self.light_solver, pixels, self.plan, self.rates, self.proxy)

    def _build_on(self, name: str, facts: SceneFacts, settings: NeilfConfig) -> None:
        """Build the model on top of a nerfstudio method, with a proxy if that cannot trace rays cheaply."""
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
        self.neilf.observers.append(self._update_proxy)
        if self.proxy is not None:
            CONSOLE.log(
                f"{name} cannot trace rays cheaply: shadows and inter-reflection are traced on a proxy of "
                "its surface that is built from the training rays"
            )

    def _update_proxy(self, batch: PixelBatch, hits: SurfaceHits) -> None:
        """Add the hits of a training step to the proxy, which only traces rays between surfaces."""
        if self.steps.traces:
            self.neilf.host.update_proxy(batch.rays, hits)

    @property
    def stage(self) -> Stage:
        """The stage of the current or last step; the first stage before training."""
        return self.steps.position.stage

    @property
    def field(self) -> nn.Module | DistanceField:
        """The distance field that `ns-export marching-cubes` reads; see `NeilfMethodConfig.sdf_field`."""
        host = self.neilf.host
        return host.inner.model.field if isinstance(host, ForeignHost) else DistanceField(host.sdf)

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
        if self.steps.number < 0:
            show_known_light(self.neilf)
        of_host = (
            self.neilf.host.inner.model.get_training_callbacks(training_callback_attributes)
            if isinstance(self.neilf.host, ForeignHost)
            else []
        )
        for optimizer in optimizers.optimizers.values():
            self.steps.guard.watch(optimizer)
        obstacle = no_record(trainer, self.config.host)
        if obstacle:
            CONSOLE.log(f"no run folder for the neilfpp commands: {obstacle}")
        else:
            self.steps.record = RunRecord.of(trainer, self.plan, self.neilf.facts)
        before = [TrainingCallbackLocation.BEFORE_TRAIN_ITERATION]
        after = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
        return [
            *of_host,
            TrainingCallback(before, self.steps.begin, args=[optimizers]),
            TrainingCallback(after, self.steps.solve_light),
            TrainingCallback(after, self.steps.check_and_save, args=[trainer]),
            TrainingCallback(after, self.steps.end_after_last, args=[trainer]),
            TrainingCallback([TrainingCallbackLocation.AFTER_TRAIN], lambda step: self.steps.end()),
        ]

    def update_to_step(self, step: int) -> None:
        """Set the step after a checkpoint has been loaded."""
        self.steps.number = step

    def get_extra_state(self) -> dict[str, Any]:
        """The decisions on effects, as plain values for checkpoints."""
        return stored_decisions(self.plan)

    def set_extra_state(self, state: dict[str, Any]) -> None:
        """Restore what `get_extra_state` returned, and use the settings that follow from it.

        Raises:
            UserError: if the checkpoint was trained with another value of `effects`.
        """
        restore_decisions(self.plan, state)
        self.neilf.use(self.plan.config)
        self.light_solver.use(self.plan.config.light, self.neilf.lobe)

    # ------------------------------------------------------------------------------------------------- losses

    def get_loss_dict(
        self, outputs: dict[str, Tensor], batch: dict[str, Any], metrics_dict: dict[str, Tensor] | None = None
    ) -> dict[str, Tensor]:
        """The weighted losses of the stage; in evaluation mode the mean absolute error of the image."""
        if not self.training:
            return {"rgb": (outputs["rgb"] - batch["image"].to(self.device)).abs().mean()}
        pixels = to_pixel_batch(outputs["origins"], outputs["directions"], batch)
        position = self.steps.position
        terms = self.steps.compute(pixels)
        weights = {
            **active_losses(position.stage, self.neilf.config, self.neilf.stages, position.share),
            OWN_LOSSES: self.config.host_losses,
        }
        total = weigh(terms, weights)
        self.steps.guard.begin_step(total.terms, self.steps.number)
        if metrics_dict is not None:
            # Nerfstudio logs the metrics after this call, so the unweighted terms can be added here.
            metrics_dict |= total.terms | self.steps.light_found()
        return {name: weigh({name: term}, weights).loss for name, term in terms.items()}

    # ------------------------------------------------------------------------------------------------ outputs

    def get_outputs(self, ray_bundle: RayBundle) -> dict[str, Tensor]:
        """All maps in evaluation mode; in training only the rays, since the losses render what they need."""
        rays = RayBatch(ray_bundle.origins, ray_bundle.directions)
        if self.training:
            return {"origins": rays.origins, "directions": rays.directions}
        # Before material is trained, its initial values are not shown.
        maps = self.neilf.maps(rays) if self.steps.has_material else self.neilf.host_maps(rays)
        return method_outputs(self.neilf, rays, maps)

    def get_rgba_image(self, outputs: dict[str, Tensor], output_name: str = "rgb") -> Tensor:
        """Display values of an output, and the opacity, for `ns-export`."""
        return stored_colors(outputs, output_name, self.neilf.facts.response)

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Any]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Figures of a view, as in `neilfpp eval`, and pictures of its maps, for nerfstudio's log."""
        batch = {key: value.to(self.device) for key, value in batch.items() if isinstance(value, Tensor)}
        response = self.neilf.facts.response
        pictures = view_pictures(outputs, batch, response)
        if self.steps.has_material:
            pictures |= material_pictures(outputs)
        return view_figures(outputs, batch, response), pictures
