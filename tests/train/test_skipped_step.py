"""A skipped step is stored, and running it again names the operation that is not finite."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method import losses
from neilfpp_method.cli import main
from neilfpp_method.errors import UserError
from neilfpp_method.settings.presets import PRESETS
from neilfpp_method.structures import LossTerm
from neilfpp_method.train.first_not_finite import OriginsOfNotFinite
from neilfpp_method.train.loop import train
from neilfpp_method.train.rerun import rerun_step, rerun_summary
from neilfpp_method.train.run import CaptureSource, create_run
from neilfpp_method.train.skipped import FOLDER, MAX_KEPT, load_step
from neilfpp_method.train.training import Training
from tests.hard_cases.hostile.readers.stored import make_step
from tests.train.small_runs import small_config, small_training


@pytest.fixture
def training(tmp_path: Path, capture: Path, monkeypatch: pytest.MonkeyPatch) -> Training:
    """A run on disk with four steps per stage."""
    config = small_config()
    made = small_training(capture, tmp_path / "run", config)
    create_run(made.path, config, CaptureSource(str(capture)), made.model.facts)
    return made


def spoil(monkeypatch: pytest.MonkeyPatch, training: Training, number: int, spoiled) -> None:
    """Let L_vol and L_phys be `spoiled(errors)` in this step, also when the step is run again."""
    step = training.model.step
    calls, now = iter(range(1000)), [number]

    def counted(*arguments):
        now[0] = next(calls)
        return step(*arguments)

    def spoiling(honest):
        def loss(*arguments):
            term = honest(*arguments)
            return LossTerm(spoiled(term.values)) if now[0] == number else term

        return loss

    training.model.step = counted
    for name in ("photometric", "physical"):
        monkeypatch.setattr(losses, name, spoiling(getattr(losses, name)))
    monkeypatch.setattr(
        "neilfpp_method.train.rerun.load_step", lambda *a: (now.__setitem__(0, number), load_step(*a))[1]
    )


@pytest.mark.parametrize("step", [2, 7, 9])
def test_a_loss_that_is_not_finite(training, monkeypatch, step):
    def divided(errors: torch.Tensor) -> torch.Tensor:
        spread = torch.ones_like(errors)
        spread[3] = 0.0
        return errors / spread / spread

    spoil(monkeypatch, training, step, divided)
    train(training)
    assert training.skipped == 1
    assert f"neilfpp replay {training.path} {step}" in "\n".join(training.reporter.said)
    assert [file.stem for file in (training.path / FOLDER).iterdir()] == [str(step)]
    found = rerun_step(training.path, step)
    assert not found.finite
    assert "aten.div.Tensor" in found.origin.operation
    assert found.origin.derivative_of is None
    assert found.origin.rows == (3,)
    assert "first operation: aten.div.Tensor" in rerun_summary(found)


def test_a_gradient_that_is_not_finite_names_the_line_of_its_operation(training, monkeypatch):
    """√0 has the value 0, and its derivative is infinite."""

    def rooted(errors: torch.Tensor) -> torch.Tensor:
        return errors + (errors[:1] * 0.0).sqrt()

    spoil(monkeypatch, training, 2, rooted)
    train(training)
    found = rerun_step(training.path, 2)
    assert found.losses == ()
    assert found.gradients
    assert found.origin.derivative_of == "SqrtBackward0"


def test_a_rerun_repeats_the_step_bit_for_bit(training, monkeypatch):
    """The losses are those of the skipped step, also in a stage that shades stored points again."""
    values, honest = [], training.model.step

    def remembering(*arguments):
        computed = honest(*arguments)
        values.append({name: term.values.detach().clone() for name, term in computed.terms.items()})
        if len(values) == 7:
            return computed._replace(
                terms={name: LossTerm(t.values * math.nan) for name, t in computed.terms.items()}
            )
        return computed

    training.model.step = remembering
    train(training)
    again: list[dict] = []
    weigh = "neilfpp_method.train.rerun.weigh"
    from neilfpp_method.train import rerun

    original = rerun.weigh
    monkeypatch.setattr(
        weigh,
        lambda terms, weights: (
            again.append({n: t.values.detach() for n, t in terms.items()}),
            original(terms, weights),
        )[1],
    )
    found = rerun_step(training.path, 6)
    assert found.finite
    assert "finite now" in rerun_summary(found)
    assert values[6].keys() == again[0].keys()
    for name, value in values[6].items():
        assert torch.equal(value, again[0][name]), name


def test_the_first_skipped_steps_are_stored(training):
    honest = training.model.step
    training.model.step = lambda *a: (r := honest(*a))._replace(
        terms={name: LossTerm(t.values * math.nan) for name, t in r.terms.items()}
    )
    with pytest.raises(Exception, match="10 steps in a row"):
        train(training)
    assert sorted(int(file.stem) for file in (training.path / FOLDER).iterdir()) == list(range(MAX_KEPT))


def test_an_infinity_that_a_mask_removes_is_not_reported():
    with OriginsOfNotFinite() as origins:
        x = torch.tensor([0.0, 1.0])
        harmless = torch.where(x > 0, 1.0 / x, 0.0)
        wrong = harmless.log() * 0.0 + 1.0
    assert origins.origin_of(harmless) is None
    assert "log" in origins.origin_of(wrong).operation
    assert origins.origin_of(wrong).rows == (0,)


def test_memory_that_is_used_again_has_no_origin():
    """Freed memory is given to the next tensor, and a compiled loop may write a NaN there."""
    memory = np.zeros(4, dtype=np.float32)
    with OriginsOfNotFinite() as origins:
        gone = torch.from_numpy(memory).log_()
        assert "log" in origins.origin_of(gone).operation
        del gone
        memory[:] = (0.0, math.nan, 0.0, 0.0)
        wrong = torch.from_numpy(memory) * 2.0
    assert origins.origin_of(wrong) is None


def test_a_step_that_is_not_stored(training, monkeypatch, capfd):
    monkeypatch.setitem(PRESETS, "tiny", small_config)
    with pytest.raises(UserError, match="step 3 is not a stored skipped step; the run has skipped no step"):
        load_step(training.path, 3)
    assert main(["replay", str(training.path), "3"]) == 2
    (training.path / FOLDER).mkdir()
    (training.path / FOLDER / "3.pt").write_bytes(b"not a step")
    assert main(["replay", str(training.path), "3"]) == 2
    assert capfd.readouterr().err.count("\n") == 2


@pytest.mark.parametrize(
    ("part", "value"),
    [
        ("random", torch.zeros(8, dtype=torch.uint8)),
        ("random", torch.full_like(torch.get_rng_state(), 255)),
        ("random", None),
        ("step", "7"),
        ("share", math.nan),
        ("share", "half"),
        ("stage", "none"),
        ("batch", {}),
        ("model", None),
    ],
)
def test_a_stored_step_with_other_values_is_refused(tmp_path, part, value):
    (path,) = make_step(tmp_path)
    assert load_step(tmp_path, 7).step == 7
    torch.save(torch.load(path, weights_only=True) | {part: value}, path)
    with pytest.raises(UserError, match=r"not a complete step .*; train again"):
        load_step(tmp_path, 7)


def test_a_stored_batch_of_another_shape_is_refused(tmp_path):
    (path,) = make_step(tmp_path)
    stored = torch.load(path, weights_only=True)
    for name, value in {"mask": torch.ones(3), "color": torch.ones(4, 2), "view": torch.ones(4)}.items():
        torch.save(stored | {"batch": stored["batch"] | {name: value}}, path)
        with pytest.raises(UserError, match="not a complete step"):
            load_step(tmp_path, 7)
