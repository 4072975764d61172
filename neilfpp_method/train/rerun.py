"""Run a skipped step again from its stored rays and weights, to find what in it is not finite."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import torch
from torch.autograd import anomaly_mode

from neilfpp_method.data.capture import Capture
from neilfpp_method.data.pixels.dataset import PixelDataset
from neilfpp_method.model import NeilfModel
from neilfpp_method.schedule import Stage, active_losses, weigh
from neilfpp_method.structures import PixelBatch
from neilfpp_method.train.build import build_model
from neilfpp_method.train.checkpoint import load_weights
from neilfpp_method.train.effects_record import read_plan
from neilfpp_method.train.first_not_finite import Origin, OriginsOfNotFinite, is_finite
from neilfpp_method.train.patches import show_patches
from neilfpp_method.train.poses import corrected
from neilfpp_method.train.run import PIXELS, read_description
from neilfpp_method.train.skipped import SkippedStep, load_step

__all__ = ["Rerun", "rerun_step", "rerun_summary"]

ROWS_SHOWN = 8
"""Maximum number of rays that the report of a step lists."""


@dataclass(frozen=True)
class Rerun:
    """The result of running a skipped step again.

    Attributes:
        skipped: the step.
        inputs: names of the weights and parts of the batch that are not finite before the step.
        losses: names of the losses that are not finite.
        gradients: names of the fields whose gradient is not finite.
        origin: the first operation whose non-finite result reaches one of these; None if everything is
            finite, or if the values do not come from a torch operation.
    """

    skipped: SkippedStep
    inputs: tuple[str, ...]
    losses: tuple[str, ...]
    gradients: tuple[str, ...]
    origin: Origin | None

    @property
    def finite(self) -> bool:
        """Whether everything is finite this time."""
        return not (self.inputs or self.losses or self.gradients)


def rerun_step(run: Path, step: int) -> Rerun:
    """Run a skipped step again on the CPU, with the same random numbers.

    Raises:
        UserError: if the folder is not a run, or if it has not stored this step.
    """
    described, skipped = read_description(run), load_step(run, step)
    plan = read_plan(run, described.config, step)
    capture = described.source.load_again(run)
    model = build_model(capture, described.facts, plan.config_of_model)
    model.use(plan.config)
    load_weights(model, skipped.model, run)
    model.train().freeze_for(skipped.stage)
    _show_patches(model, capture, run, skipped.stage)
    torch.set_rng_state(skipped.random)
    return _run_step(model, skipped)


def _show_patches(model: NeilfModel, capture: Capture, run: Path, stage: Stage) -> None:
    """Show the host the training views if the step compares patches of them."""
    if "patches" not in active_losses(stage, model.config, model.stages):
        return
    pixels = PixelDataset(capture, capture.train_views, folder=run / PIXELS)
    posed = pixels if model.poses is None else pixels.posed(corrected(capture, model.poses))
    show_patches(model, posed, stage)


def _run_step(model: NeilfModel, skipped: SkippedStep) -> Rerun:
    """Run a step with a model that has its weights, and report what in it is not finite."""
    inputs = tuple(_inputs_not_finite(model, skipped.batch))
    weights = active_losses(skipped.stage, model.config, model.stages, skipped.share)
    # Anomaly mode stores with each derivative the source line of its forward operation.
    with anomaly_mode.set_detect_anomaly(True, check_nan=False), OriginsOfNotFinite() as origins:
        terms = model.step(skipped.batch, skipped.stage).terms
        total = weigh(terms, weights)
        if total.loss.requires_grad:
            total.loss.backward()
    losses = tuple(name for name, value in total.terms.items() if not math.isfinite(value.item()))
    bad_gradients = {
        name: [p.grad for p in parameters if p.grad is not None and not is_finite(p.grad)]
        for name, parameters in model.parameter_groups().items()
    }
    fields_not_finite = tuple(name for name, gradients in bad_gradients.items() if gradients)
    results = [terms[name].values for name in losses]
    results += [gradient for gradients in bad_gradients.values() for gradient in gradients]
    known = [origin for result in results if (origin := origins.origin_of(result)) is not None]
    first = min(known, key=lambda origin: origin.order, default=None)
    return Rerun(skipped, inputs, losses, fields_not_finite, first)


def _inputs_not_finite(model: NeilfModel, batch: PixelBatch) -> Iterator[str]:
    """Names of the parameters and parts of the batch that are not finite."""
    yield from (name for name, p in model.named_parameters() if not is_finite(p))
    yield from (f.name for f in fields(batch) if not is_finite(getattr(batch, f.name)))


def rerun_summary(rerun: Rerun) -> str:
    """A report of a few lines for the console."""
    skipped, origin = rerun.skipped, rerun.origin
    lines = [f"step {skipped.step}, stage {skipped.stage.value}, {len(skipped.batch)} rays"]
    if rerun.finite:
        lines.append("every loss and gradient is finite now; the values came from another process or device")
        return "\n".join(lines)
    parts = {"inputs": rerun.inputs, "losses": rerun.losses, "gradients": rerun.gradients}
    lines += [f"{what} that are not finite: {', '.join(names)}" for what, names in parts.items() if names]
    if origin is None:
        lines.append(
            "first operation: not a torch operation; the values are in the inputs or from a compiled loop"
        )
        return "\n".join(lines)
    derivative = f", in the derivative of {origin.derivative_of}" if origin.derivative_of else ""
    lines.append(f"first operation: {origin.operation}{derivative}")
    lines.append(f"values: {origin.broken} of {origin.values} are not finite")
    if origin.place:
        lines.append(f"at {origin.place}: {origin.code}")
    if origin.length == len(skipped.batch):
        views = skipped.batch.view[list(origin.rows[:ROWS_SHOWN])].tolist()
        more = " …" if len(origin.rows) > ROWS_SHOWN else ""
        rays = ", ".join(f"{row} (training view {v})" for row, v in zip(origin.rows, views, strict=False))
        lines.append(f"rays: {rays}{more}")
    return "\n".join(lines)
