"""The work before and after each step of nerfstudio's trainer, as the standalone loop does it.

Before a step: the stage, the learning rates and the random numbers. After it: the light, the search for
materials, the health of the run, the effects of the next stage, and the run folder.
"""

from __future__ import annotations

import dataclasses
from contextlib import ExitStack

import torch
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor, nn

from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.effects.following import follow_fit
from neilfpp_method.effects.plan import Plan
from neilfpp_method.effects.table import effects_table
from neilfpp_method.health.guard import StepGuard
from neilfpp_method.health.watch import CHECKED_PIXELS, Watch
from neilfpp_method.hosts.proxy import SurfaceProxy
from neilfpp_method.kernels.process import computing_fast
from neilfpp_method.lighting.fit import Evidence
from neilfpp_method.model import NeilfModel
from neilfpp_method.plugin.record import RunRecord
from neilfpp_method.schedule import Stage, StagePosition, has_material, stage_at, total_steps
from neilfpp_method.settings.types import OptimizerConfig
from neilfpp_method.structures import LossTerms, PixelBatch, StepResult
from neilfpp_method.train.deciding import (
    Subject,
    correct_final_scale,
    improve_half_trained,
    is_improvement_due,
    review_before_material,
)
from neilfpp_method.train.effects_record import write_plan
from neilfpp_method.train.health_record import write_findings
from neilfpp_method.train.optimizer import (
    Stream,
    limit_surface_width,
    seed_step,
    seed_stream,
    set_rates,
    waiting_fields,
)
from neilfpp_method.train.patches import show_patches
from neilfpp_method.train.skipped import Moment
from neilfpp_method.train.vanished import restore_surface

__all__ = ["Steps"]


class Steps:
    """The state of a training between its steps.

    Args:
        neilf: the method.
        light_solver: finds the environment map and the lamps of `neilf` between steps.
        pixels: the training pixels.
        plan: the effects, from whose settings the method is built.
        rates: the learning rates.
        proxy: the surface on which rays are traced for a nerfstudio model; None if none is needed.

    Attributes:
        number: number of the current or last step; -1 before training.
        watch: the findings of the health checks.
        guard: skips steps that are not finite.
        record: writes the run folder; None before training, and if no folder can be written.
    """

    def __init__(
        self,
        neilf: NeilfModel,
        light_solver: nn.Module,
        pixels: PixelDataset,
        plan: Plan,
        rates: OptimizerConfig,
        proxy: SurfaceProxy | None,
    ) -> None:
        self.neilf, self.light_solver, self.pixels = neilf, light_solver, pixels
        self.plan, self.rates, self.proxy = plan, rates, proxy
        self.settings = plan.config_of_model
        seed_stream(self.settings.train.seed, Stream.HEALTH)
        self.watch = Watch(pixels.sample(CHECKED_PIXELS, gradients=False), CONSOLE.log, CONSOLE.log)
        self.guard = StepGuard(self._report_skipped)
        self.record: RunRecord | None = None
        self.number = -1
        # The state with which the current step can be repeated, and what the step computed, until the light
        # is solved.
        self._moment: Moment | None = None
        self._computed: StepResult | None = None
        # The last evidence for lamps, the stage for which fields are frozen, and the process-wide settings of
        # training, which are restored at its end.
        self._evidence: Evidence | None = None
        self._set_up_for: Stage | None = None
        self._while_training = ExitStack()

    @property
    def position(self) -> StagePosition:
        """The position of the current or last step in its stage; the first stage before training."""
        return stage_at(self.number, self.settings.train)

    @property
    def traces(self) -> bool:
        """Whether rays between surfaces are traced."""
        return self.neilf.config.light.inter_reflection != "off"

    @property
    def has_material(self) -> bool:
        """Whether material has been trained."""
        return has_material(self.number + 1, self.settings.train)

    # ---------------------------------------------------------------------------------- before and in a step

    def begin(self, optimizers: Optimizers, step: int) -> None:
        """Set up the stage if it is new, then the learning rates and the random numbers of the step."""
        self.number, position = step, stage_at(step, self.settings.train)
        if self._set_up_for is None:
            # As in `neilfpp train`, denormal numbers are flushed to zero: arithmetic with them is slow on a
            # CPU, and the two would round differently.
            self._while_training.enter_context(computing_fast())
            self.pixels = self.pixels.on(self._device)
        if self._set_up_for is not position.stage:
            if step == 0:
                self._review_before_stage(step)
            self.neilf.freeze_for(position.stage)
            show_patches(self.neilf, self.pixels, position.stage)
            self._set_up_for = position.stage
        waiting = waiting_fields(self.neilf, self.rates, position)
        for optimizer in optimizers.optimizers.values():
            set_rates(optimizer, self.rates, position, waiting)
        seed_step(self.settings.train.seed, step)

    def compute(self, pixels: PixelBatch) -> LossTerms:
        """The loss terms of a step, before their weights."""
        position = self.position
        self._moment = Moment.before_step(pixels, position, self.number)
        self._computed = self.neilf.step(pixels, position.stage)
        return self._computed.terms

    def light_found(self) -> dict[str, Tensor]:
        """The evidence for lamps of the last fit, unless the settings decide about lamps."""
        if self._evidence is None:
            return {}
        lamps = float(self.neilf.lamps.count)
        return {"lamp_gain": torch.tensor(self._evidence.gain), "lamps": torch.tensor(lamps)}

    def _report_skipped(self, text: str) -> None:
        """Log a step that was not finite, and store it in the run folder if there is one."""
        if self.record is not None and self._moment is not None:
            text += self.record.keep_skipped(self.neilf, self._moment)
        CONSOLE.log(text)

    # ------------------------------------------------------------------------------------------- after a step

    def solve_light(self, step: int) -> None:
        """Bound β, solve for the light and search the material if due, after the optimizer's step."""
        limit_surface_width(self.neilf.host, self.settings, stage_at(step, self.settings.train))
        if restore_surface(self.neilf.host, stage_at(step + 1, self.settings.train)):
            CONSOLE.log(f"step {step + 1}: the surface had vanished and is restored")
        if self._computed is None:
            return
        self.light_solver.observe(self._computed)
        self.watch.after_step(self.neilf.stages[self.position.stage], self._computed, step)
        if self.light_solver.due:
            self.watch.after_fit(self.light_solver.points, step)
        evidence = self.light_solver.solve(self.neilf.brdf, self.neilf.scene)
        self._evidence = evidence or self._evidence
        position = stage_at(step, self.settings.train)
        subject, reached = self._subject(), dataclasses.replace(position, step=position.step + 1)
        follow_fit(subject, evidence, step + 1)
        if is_improvement_due(subject, reached):
            improve_half_trained(subject, reached, step + 1)
        self._computed = None

    def check_and_save(self, trainer: Trainer, step: int) -> None:
        """Check the health at the end of a stage, and take the measurements for the next; write the run
        folder then and when nerfstudio saves.
        """
        done, position = step + 1, stage_at(step, self.settings.train)
        ends = position.step + 1 == position.length
        if ends:
            self.watch.pixels = self.watch.pixels.to(self._device)
            self.watch.after_stage(self.neilf, self.neilf.stages[position.stage], self.guard.skipped, done)
            CONSOLE.log(f"health after {position.stage.value}: {self.watch.health}")
            if self.proxy is not None and self.traces and self.proxy.report() is not None:
                CONSOLE.log(str(self.proxy.report()))
            if done < total_steps(self.settings.train):
                self._review_before_stage(done)
            else:
                correct_final_scale(self._subject(), done)
        # The condition under which nerfstudio saves.
        saves = step > 0 and step % trainer.config.steps_per_save == 0
        if ends or saves or done == trainer._start_step + trainer.config.max_num_iterations:
            write_findings(trainer.base_dir, self.watch)
            write_plan(trainer.base_dir, self.plan)
            if self.record is not None:
                self.record.save(self.neilf, self.light_solver, self.watch, trainer, done)

    def end_after_last(self, trainer: Trainer, step: int) -> None:
        """Stop after the last stage: nerfstudio counts iterations from the step at which it resumes."""
        if step + 1 >= total_steps(self.settings.train):
            trainer.stop_training = True

    def end(self) -> None:
        """Restore the process-wide settings after training, and print the effects."""
        self._while_training.close()
        if self.plan.request.base != "as-set":
            CONSOLE.print(effects_table(self.plan))

    def _review_before_stage(self, step: int) -> None:
        """Decide on effects and set the initial light, after `step` steps, if material is trained next."""
        if self.neilf.stages[stage_at(step, self.settings.train).stage].trains_material:
            self._evidence = review_before_material(self._subject(), step) or self._evidence

    def _subject(self) -> Subject:
        seed = self.settings.train.seed
        return Subject(self.plan, self.neilf, self.light_solver, CONSOLE.log, self.pixels, seed)

    @property
    def _device(self) -> torch.device:
        return self.neilf.lamps.position.device
