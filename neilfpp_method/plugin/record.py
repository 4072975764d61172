"""A run of `ns-train` as a run folder, `neilfpp` beside its `config.yml`: what `neilfpp export`, `eval`,
`relight`, `report`, `render`, `view` and `train --resume` read.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from nerfstudio.engine.trainer import Trainer
from torch import nn

from neilfpp_method.health.watch import Watch
from neilfpp_method.model import NeilfModel
from neilfpp_method.plugin.dataparser import CaptureParserConfig
from neilfpp_method.settings.facts import SceneFacts
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.train.health_record import write_findings
from neilfpp_method.train.optimizer import make_optimizer
from neilfpp_method.train.run import BESIDE_NERFSTUDIO, CaptureSource, create_run, save_checkpoint

__all__ = ["RunRecord", "no_record"]


def no_record(trainer: Trainer, host: str | None) -> str | None:
    """Why a training cannot be kept as a run folder, a clause; none: it can."""
    if host is not None:
        return f"the host {host} is nerfstudio's own: use the ns-* commands, ns-export among them"
    if not isinstance(trainer.config.pipeline.datamanager.dataparser, CaptureParserConfig):
        return "its images come from another dataparser than neilfpp-data: use the ns-* commands"
    return None


@dataclass(frozen=True)
class RunRecord:
    """Writes the folder, its description with the first checkpoint.

    Attributes:
        path: the folder.
        config: the settings as they are trained, with as many rays as nerfstudio's data manager draws.
        source: how the capture is read again.
        facts: what the images decided.
    """

    path: Path
    config: NeilfConfig
    source: CaptureSource
    facts: SceneFacts

    @staticmethod
    def of(trainer: Trainer, settings: NeilfConfig, facts: SceneFacts) -> RunRecord:
        """The folder beside the configuration of a trainer."""
        pixels = trainer.config.pipeline.datamanager
        parser = pixels.dataparser
        train = dataclasses.replace(settings.train, rays=pixels.train_num_rays_per_batch)
        data = pixels.data or parser.data
        source = CaptureSource(str(Path(data).resolve()), parser.test_every, parser.response, parser.format)
        config = dataclasses.replace(settings, train=train)
        return RunRecord(Path(trainer.base_dir) / BESIDE_NERFSTUDIO, config, source, facts)

    def save(
        self, model: NeilfModel, light_solver: nn.Module, watch: Watch, trainer: Trainer, steps: int
    ) -> None:
        """The state after `steps` steps, with that of nerfstudio's optimisers as one, as `neilfpp train` has
        it.

        Raises:
            UserError: the folder cannot be written.
        """
        if not (self.path / "config.json").is_file():
            create_run(self.path, self.config, self.source, self.facts)
        write_findings(self.path, watch)
        optimizer = make_optimizer(model, self.config.optimizer)
        for theirs in trainer.optimizers.optimizers.values():
            optimizer.state.update(theirs.state)
        save_checkpoint(self.path / "checkpoints" / "last.pt", model, light_solver, optimizer, steps)
