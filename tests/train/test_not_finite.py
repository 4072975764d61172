"""A step that is not finite changes nothing, is counted, and its cause is reported; ten in a row end the
training.
"""

from __future__ import annotations

import copy
import json
import math

import pytest
import torch

from neilfpp_method.cli import main
from neilfpp_method.errors import Diverged
from neilfpp_method.model import NeilfModel
from neilfpp_method.settings.presets import PRESETS
from neilfpp_method.structures import LossTerm
from neilfpp_method.train import loop
from neilfpp_method.train.checkpoint import last_checkpoint
from neilfpp_method.train.loop import train
from neilfpp_method.train.training import Training
from tests.train.small_runs import differences, small_config, small_training

# Four steps in each of three stages: 0–3, 4–7, 8–11.


def spoil_loss(
    training: Training, name: str, steps: range | tuple[int, ...], value: float = math.nan
) -> None:
    """Replace a loss by `value` at these steps."""
    honest, calls = training.model.step, iter(range(1000))

    def spoiled(*arguments):
        computed = honest(*arguments)
        if next(calls) not in steps:
            return computed
        return computed._replace(terms=computed.terms | {name: LossTerm(computed.terms[name].values * value)})

    training.model.step = spoiled


def spoil_gradient(training: Training, field: str, steps: tuple[int, ...]) -> None:
    """Replace the gradient of a field by NaN at these steps; the loss stays finite."""
    honest, calls = training.model.step, iter(range(1000))
    parameter = training.model.parameter_groups()[field][0]
    current = [0]

    def counted(*arguments):
        current[0] = next(calls)
        return honest(*arguments)

    training.model.step = counted
    parameter.register_hook(lambda gradient: gradient * math.nan if current[0] in steps else gradient)


def watch(training: Training, patch: pytest.MonkeyPatch) -> list[dict]:
    """The whole state, parameters and optimizer, after each step."""
    states, made = [], []
    make_optimizer, step = loop.make_optimizer, training.reporter.step

    def remember(*arguments):
        made.append(make_optimizer(*arguments))
        return made[0]

    def look(loss, psnr):
        step(loss, psnr)
        states.append(
            copy.deepcopy({"model": training.model.state_dict(), "optimizer": made[0].state_dict()["state"]})
        )

    patch.setattr(loop, "make_optimizer", remember)
    patch.setattr(training.reporter, "step", look)
    return states


@pytest.mark.parametrize(
    ("name", "step"), [("volume", 2), ("eikonal", 1), ("physical", 6), ("lambertian", 9)]
)
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_loss_that_is_not_finite(tmp_path, capture, monkeypatch, name, step, value):
    training = small_training(capture, tmp_path, small_config())
    spoil_loss(training, name, (step,), value)
    states = watch(training, monkeypatch)
    train(training)
    assert differences(states[step - 1], states[step]) == []
    assert differences(states[step], states[step + 1])
    assert training.skipped == 1
    (line,) = training.reporter.said
    assert f"step {step} skipped: loss {name} is not finite (1 skipped so far)" in line


@pytest.mark.parametrize(("field", "step"), [("geometry", 2), ("light", 6), ("brdf", 10)])
def test_a_gradient_that_is_not_finite(tmp_path, capture, monkeypatch, field, step):
    training = small_training(capture, tmp_path, small_config())
    spoil_gradient(training, field, (step,))
    states = watch(training, monkeypatch)
    train(training)
    assert differences(states[step - 1], states[step]) == []
    assert differences(states[step], states[step + 1])
    assert training.skipped == 1
    assert math.isfinite(training.reporter.losses[step])
    (line,) = training.reporter.said
    assert f"step {step} skipped: the gradient of {field} is not finite" in line


def test_a_step_that_is_not_finite_in_another_process(tmp_path, capture, monkeypatch):
    """The mean over all processes is not finite if one value is not, so all processes skip the step."""
    training = small_training(capture, tmp_path, small_config())
    states, calls = watch(training, monkeypatch), iter(range(1000))
    monkeypatch.setattr(
        training.fabric, "all_reduce", lambda known: known * (math.nan if next(calls) == 5 else 1.0)
    )
    train(training)
    assert differences(states[4], states[5]) == []
    assert differences(states[5], states[6])
    assert training.skipped == 1


def test_skipped_steps_are_counted(tmp_path, capture):
    training = small_training(capture, tmp_path, small_config())
    spoil_loss(training, "eikonal", (0, 1, 3, 8))
    train(training)
    assert training.skipped == 4
    for line, step, count in zip(training.reporter.said, (0, 1, 3, 8), (1, 2, 3, 4), strict=True):
        assert f"step {step} skipped: loss eikonal is not finite ({count} skipped so far)" in line
    assert all(p.isfinite().all() for p in training.model.parameters())


def test_nine_in_a_row_do_not_end_the_training(tmp_path, capture):
    training = small_training(capture, tmp_path, small_config(sdf_steps=40))
    spoil_loss(training, "volume", (*range(2, 11), *range(12, 21)))
    train(training)
    assert training.skipped == 18


def test_ten_in_a_row_end_the_training(tmp_path, capture, monkeypatch):
    training = small_training(capture, tmp_path, small_config(sdf_steps=40))
    spoil_loss(training, "volume", range(7, 40))
    states = watch(training, monkeypatch)
    with pytest.raises(
        Diverged, match="10 steps in a row were not finite, the last one in loss volume"
    ) as caught:
        train(training)
    assert str(last_checkpoint(tmp_path).parent) in caught.value.remedy
    assert training.skipped == 10
    # Steps 0 to 6 were finite; the checkpoint, made every third step, has the state after step 6.
    saved = torch.load(last_checkpoint(tmp_path), weights_only=True)
    assert differences(saved["model"], states[6]["model"]) == []
    assert differences(saved["optimizer"]["state"], states[6]["optimizer"]) == []


def test_the_command_ends_with_status_1(tmp_path, capture, monkeypatch, capfd):
    honest = NeilfModel.step

    def spoiled(*arguments):
        computed = honest(*arguments)
        return computed._replace(
            terms={name: LossTerm(t.values * math.nan) for name, t in computed.terms.items()}
        )

    monkeypatch.setitem(PRESETS, "tiny", small_config)
    monkeypatch.setattr(NeilfModel, "step", spoiled)
    out = tmp_path / "run"
    options = ["--preset", "tiny", "--config.train.sdf-steps", "20", "--device", "cpu"]
    assert main(["train", "--data", str(capture), "--out", str(out), *options]) == 1
    said = capfd.readouterr()
    assert said.err.startswith("error: 10 steps in a row were not finite, the last one in loss ")
    assert said.err.count("\n") == 1
    assert said.out.count("skipped:") == 10
    assert json.loads((out / "config.json").read_text())["config"]["train"]["sdf_steps"] == 20
