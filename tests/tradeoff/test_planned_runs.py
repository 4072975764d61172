"""The runs of a tradeoff: finished ones are kept, stopped ones continue, too small budgets are left out."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from neilfpp_method.cli import main
from neilfpp_method.data.files.images import write_exr
from neilfpp_method.errors import UserError
from neilfpp_method.relight.request import RelightRequest
from neilfpp_method.settings import presets
from neilfpp_method.settings.plain import changed
from neilfpp_method.tradeoff import planned_runs, relighting
from neilfpp_method.tradeoff.planned_runs import TradeoffRequest, plan_runs
from neilfpp_method.train.budget_record import read_budget
from tests.data.make_capture import make_capture
from tests.train.small_runs import small_config
from tests.train.test_budget import STEPS, clock
from tests.train.test_resume import files, interrupt_at

__all__ = ["clock"]  # a fixture


@pytest.fixture
def words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    config = small_config(**STEPS)
    monkeypatch.setitem(presets.PRESETS, "fast", lambda: config)
    capture = make_capture(tmp_path / "sphere", size=(48, 36), masks=True)
    return ["tradeoff", "--data", str(capture), "--out", str(tmp_path / "out"), "--device", "cpu"]


def test_a_second_call_continues_and_repeats_nothing(tmp_path, words, clock, monkeypatch, capsys):
    out = tmp_path / "out"
    words += ["--budgets", "2m,1s,3m"]
    with monkeypatch.context() as patch:
        interrupt_at(patch, 12)
        assert main(words) == 130  # in the run of 2m, as that of 1s is too small
    assert "left out: a budget of 1s is too small" in capsys.readouterr().out
    assert read_budget(out / "2m-seed0").took is None
    # `neilfpp eval` has measured the stopped run.
    (out / "2m-seed0" / "metrics.json").write_text('{"pbr_psnr": 99.0}')
    assert main(words) == 0
    assert "stopped" not in capsys.readouterr().err
    points = json.loads((out / "tradeoff.json").read_text())["points"]
    assert [point["budget"] for point in points] == [120.0, 180.0]
    assert points[0]["seconds"] == pytest.approx(120.0, rel=0.1)
    assert {"base_color_psnr_scaled", "pbr_psnr", "held_back_psnr"} <= set(points[0]["figures"])
    assert points[0]["figures"]["pbr_psnr"] < 99.0
    assert not (out / "1s-seed0").exists()

    before = files(out / "2m-seed0") | files(out / "3m-seed0")
    assert main(words) == 0
    assert files(out / "2m-seed0") | files(out / "3m-seed0") == before

    assert main([*words, "--host", "mesh"]) == 2
    assert "another capture or with other settings" in capsys.readouterr().err


def test_a_run_that_cannot_be_measured_is_left_out(tmp_path, words, clock, monkeypatch, capsys):
    """A run without a surface fails in evaluation; the others still make a frontier."""
    measure = planned_runs.evaluate

    def fails_for_2m(run):
        if run.path.name == "2m-seed0":
            raise UserError("no surface within 3 scene units", "train for longer")
        return measure(run)

    monkeypatch.setattr(planned_runs, "evaluate", fails_for_2m)
    assert main([*words, "--budgets", "2m,3m"]) == 0
    assert "left out: no surface within 3 scene units" in capsys.readouterr().out
    points = json.loads((tmp_path / "out" / "tradeoff.json").read_text())["points"]
    assert [point["budget"] for point in points] == [180.0]
    assert "pbr_psnr" in points[0]["figures"]


def test_a_run_that_differs_in_any_setting_is_refused_by_name(tmp_path, words, clock, monkeypatch, capsys):
    assert main([*words, "--budgets", "2m"]) == 0
    run = tmp_path / "out" / "2m-seed0"
    assert main([*words, "--budgets", "2m"]) == 0

    wider = changed(small_config(**STEPS), {"brdf.width": 24})
    with monkeypatch.context() as patch:
        patch.setitem(presets.PRESETS, "fast", lambda: wider)
        capsys.readouterr()
        assert main([*words, "--budgets", "2m"]) == 2
        before = small_config().brdf.width
        assert f"brdf.width is {before}, not 24; choose another --out" in capsys.readouterr().err

    for name, key, value, message in (
        ("effects.json", "request", "none", "--effects is none, not auto"),
        ("plan.json", "budget", 119.0, "the budget in seconds is 119.0, not 120.0"),
        ("capture.json", "response", "srgb", "capture.response is srgb, not auto"),
    ):
        text = (run / name).read_text()
        (run / name).write_text(json.dumps({**json.loads(text), key: value}))
        assert main([*words, "--budgets", "2m"]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
        (run / name).write_text(text)
    assert main([*words, "--budgets", "2m"]) == 0


def test_no_budget_is_large_enough(tmp_path, words, clock, capsys):
    assert main([*words, "--budgets", "1s"]) == 2
    assert "no run could be made" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_budget_that_an_earlier_run_has_shown_to_be_too_small_is_not_tried(words, clock, capsys):
    """The trial of 1s shows that 14.5 s are needed; its second seed and 10s are refused without a trial."""
    assert main([*words, "--budgets", "1s,10s,2m", "--seeds", "2"]) == 0
    said = capsys.readouterr().out
    assert said.count("measuring a few steps of each stage") == 3  # 1s-seed0 and both runs of 2m
    for name in ("1s-seed1", "10s-seed0", "10s-seed1"):
        assert f"{name} left out: a budget of {name.split('-')[0]} is too small, as an earlier run" in said
        assert f": {name}\n" not in said


@pytest.mark.slow
def test_relit_views_are_compared_without_another_training(tmp_path, words, clock, monkeypatch, capsys):
    monkeypatch.setattr(relighting, "RelightRequest", partial(RelightRequest, resolution=32))
    out, words = tmp_path / "out", [*words, "--budgets", "2m,3m"]
    assert main(words) == 0
    checkpoints = {name: files(out / name / "checkpoints") for name in ("2m-seed0", "3m-seed0")}
    assert "relight_psnr_scaled" not in (out / "tradeoff.csv").read_text()

    sky = tmp_path / "studio.exr"
    write_exr(sky, {"RGB": np.full((8, 16, 3), 0.5, np.float32)})
    truth = tmp_path / "truth"
    write_exr(truth / "000.exr", {"RGB": np.full((36, 48, 3), 0.25, np.float32)})
    relit = [*words, "--relight", str(sky), "--truth", str(truth)]
    assert main(relit) == 0
    assert {name: files(out / name / "checkpoints") for name in checkpoints} == checkpoints
    points = json.loads((out / "tradeoff.json").read_text())["points"]
    for name, point in zip(checkpoints, points, strict=True):
        (measured,) = (out / name / "relit").glob("tradeoff-*/studio/metrics.json")
        figures = json.loads(measured.read_text())
        assert point["figures"]["relight_psnr_scaled"] == figures["relight_psnr_scaled"] > 0
    assert "relight_psnr_scaled" in (out / "tradeoff.csv").read_text().splitlines()[0].split(",")
    assert "relit views, scaled" in (out / "tradeoff.svg").read_text()

    before = files(out / "2m-seed0")
    capsys.readouterr()
    assert main(relit) == 0
    assert files(out / "2m-seed0") == before
    assert "2 of 2 runs are finished already" in capsys.readouterr().out

    # Other true images of the same names are compared, too.
    write_exr(truth / "000.exr", {"RGB": np.random.default_rng(0).random((36, 48, 3), np.float32)})
    assert main(relit) == 0
    after = json.loads((out / "tradeoff.json").read_text())["points"]
    assert after[0]["figures"]["relight_psnr_scaled"] < points[0]["figures"]["relight_psnr_scaled"] - 1


def test_relighting_needs_a_map_and_true_images(tmp_path, words, capsys):
    sky, small = tmp_path / "studio.exr", tmp_path / "small"
    write_exr(sky, {"RGB": np.ones((8, 16, 3), np.float32)})
    write_exr(small / "000.exr", {"RGB": np.ones((3, 4, 3), np.float32)})
    for options, complaint in (
        (["--relight", sky], "--relight and --truth belong together"),
        (["--truth", small], "--relight and --truth belong together"),
        (["--relight", sky, "--truth", small], "4×3 pixels, but the view has 48×36"),
        (["--relight", sky, "--truth", tmp_path], "no true image of the view 000"),
        (["--relight", small / "000.exr", "--truth", small], "environment map"),
    ):
        assert main([*words, "--budgets", "2m", *map(str, options)]) == 2
        error = capsys.readouterr().err
        assert complaint in error
        assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--budgets", "soon"], "not a duration"),
        (["--budgets", "1m,60s"], "contains a budget twice"),
        (["--budgets", "60s,60.2s"], "contains a budget twice"),  # both would be 1m-seed0
        (["--budgets", ","], "--budgets is empty"),
        (["--seeds", "0"], "--seeds is 0"),
        (["--device", "abacus"], "no device 'abacus'"),
        (["--device", "cpu,abacus"], "'abacus' is not a single device"),
        (["--device", "cpu,"], "'' is not a single device"),
        (["--device", "cpu,cuda:0"], "cannot be compared by time"),
        (["--device", "cuda:0,cuda:0"], "a GPU occurs twice"),
        (["--device", "cuda:998,cuda:999"], "no device 'cuda:998' here"),
        (["--slurm", "partition"], "'partition' is not NAME=VALUE"),
        (["--slurm", ""], "'' is not NAME=VALUE"),
        (["--slurm", "qos=a,qos=b"], "qos occurs twice"),
        (["--slurm", "nodes=2"], "a run is one process, not nodes=2"),
        (["--slurm", "partition=gpu"], "no command srun here"),
        (["--slurm", "partition=gpu", "--device", "cpu,cpu"], "--slurm starts each run on one device"),
    ],
)
def test_bad_input_is_one_line(tmp_path, words, options, complaint, capsys, monkeypatch):
    monkeypatch.setenv("PATH", "")  # without the commands of a cluster
    assert main([*words, *options]) == 2
    assert complaint in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_seeds_start_at_that_of_the_settings(tmp_path):
    found = plan_runs(TradeoffRequest(tmp_path, tmp_path, small_config(seed=3), [180.0, 60.0], 2, "cpu"))
    assert [run.name for run in found] == ["1m-seed3", "1m-seed4", "3m-seed3", "3m-seed4"]
    assert [run.config.train.seed for run in found] == [3, 4, 3, 4]
    with pytest.raises(UserError, match="contains a budget twice"):
        plan_runs(TradeoffRequest(tmp_path, tmp_path, small_config(), [60.0, 60.0], 1, "cpu"))
