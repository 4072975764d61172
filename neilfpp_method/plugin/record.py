"""Write a training of `ns-train` as a run folder, `neilfpp` next to nerfstudio's `config.yml`.

The commands `neilfpp export`, `eval`, `relight`, `report`, `render`, `view` and `train --resume` read it.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from nerfstudio.engine.trainer import Trainer
from torch import nn

from neilfpp_method.effects.plan import Plan
from neilfpp_method.health.watch import Watch
from neilfpp_method.model import NeilfModel
from neilfpp_method.plugin.dataparser import CaptureParserConfig
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.train.checkpoint import last_checkpoint, save_checkpoint
from neilfpp_method.train.effects_record import write_plan
from neilfpp_method.train.health_record import write_findings
from neilfpp_method.train.optimizer import make_optimizer
from neilfpp_method.train.run import BESIDE_NERFSTUDIO, CaptureSource, create_run
from neilfpp_method.train.skipped import Moment, keep_with_note

__all__ = ["RunRecord", "no_record"]


def no_record(trainer: Trainer, host: str | None) -> str | None:
    """The reason why a training cannot be written as a run folder; None if it can."""
    if host is not None:
        return f"the host {host} belongs to nerfstudio: use the ns-* commands, for example ns-export"
    if not isinstance(trainer.config.pipeline.datamanager.dataparser, CaptureParserConfig):
        return "the images come from another dataparser than neilfpp-data: use the ns-* commands"
    return None


@dataclass(frozen=True)
class RunRecord:
    """Writes the run folder of a training; settings and source are written first.

    Attributes:
        path: the run folder.
        config: the settings, with the number of rays of nerfstudio's data manager.
        source: the location of the capture and how it is read.
        facts: facts measured in the images.
        plan: the effects.
    """

    path: Path
    config: NeilfConfig
    source: CaptureSource
    facts: SceneFacts
    plan: Plan

    @staticmethod
    def of(trainer: Trainer, plan: Plan, facts: SceneFacts) -> RunRecord:
        """The record of a trainer, next to its `config.yml`."""
        manager = trainer.config.pipeline.datamanager
        parser = manager.dataparser
        train = dataclasses.replace(plan.settings.train, rays=manager.train_num_rays_per_batch)
        config = dataclasses.replace(plan.settings, train=train)
        data = Path(manager.data or parser.data).resolve()
        source = CaptureSource(str(data), parser.test_every, parser.response, parser.format)
        return RunRecord(Path(trainer.base_dir) / BESIDE_NERFSTUDIO, config, source, facts, plan)

    def save(
        self, model: NeilfModel, light_solver: nn.Module, watch: Watch, trainer: Trainer, steps: int
    ) -> None:
        """Write the state after `steps` steps.

        The states of nerfstudio's optimizers are merged into that of a single one, as in `neilfpp train`.

        Raises:
            UserError: if the folder cannot be written.
        """
        self._create()
        write_findings(self.path, watch)
        write_plan(self.path, self.plan)
        optimizer = make_optimizer(model, self.plan.config.optimizer)
        for theirs in trainer.optimizers.optimizers.values():
            optimizer.state.update(theirs.state)
        save_checkpoint(last_checkpoint(self.path), model, light_solver, optimizer, steps)

    def keep_skipped(self, model: NeilfModel, moment: Moment) -> str:
        """Store a skipped step for `neilfpp replay`, and return the end of the message that reports it.

        Raises:
            UserError: if the run folder cannot be created.
        """
        self._create()
        return keep_with_note(self.path, model, moment)

    def _create(self) -> None:
        """Write settings, source and effects unless they have been written."""
        if not (self.path / "config.json").is_file():
            create_run(self.path, self.config, self.source, self.facts)
            write_plan(self.path, self.plan)
