"""Known light: the exported map of one run is used in another, and the record of the decision on lamps."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path

import pytest
import torch

from neilfpp_method.cli import main
from neilfpp_method.data.files.images import read_image
from neilfpp_method.errors import UserError
from neilfpp_method.lighting.decision import MIN_SAMPLES
from neilfpp_method.lighting.solver import NothingToSolve
from neilfpp_method.settings.presets import PRESETS
from neilfpp_method.settings.types import FreeLightConfig, LightFitConfig, MapLightConfig, NeilfConfig
from neilfpp_method.train.checkpoint import checkpoint_path, last_checkpoint
from neilfpp_method.train.light_record import LightFit, light_summary, read_fits, write_fits
from neilfpp_method.train.run import load_run
from tests.calls import refused, train_tiny
from tests.train.small_runs import short_light_fits, small_config


def mapped_config() -> NeilfConfig:
    """Milliseconds per step, with an environment map and lamps that are fitted at every second step."""
    config = small_config()
    fit = LightFitConfig(points=60, every=2)
    return dataclasses.replace(
        config,
        light=MapLightConfig(kind="auto", environment_height=6, fit=fit, inter_reflection="off"),
    )


@pytest.fixture(scope="module")
def capture(masked_capture: Path) -> Path:
    return masked_capture


def export_map(run: Path) -> Path:
    """Export the map of a run and return its file."""
    assert main(["export", str(run), "--what", "light", "--device", "cpu"]) == 0
    return run / "export" / "light" / "environment.exr"


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory, capture: Path) -> Path:
    """The exported map of a run."""
    return export_map(train(capture, tmp_path_factory.mktemp("runs") / "first"))


@pytest.fixture
def sky(exported: Path, tmp_path: Path) -> Path:
    """A copy of that map which a test may remove."""
    return Path(shutil.copy(exported, tmp_path / "sky.exr"))


def train(capture: Path, out: Path, *options: object) -> Path:
    return train_tiny(capture, out, *options, config=mapped_config)


def radiance_of(run: Path) -> torch.Tensor:
    return load_run(run).model.light.log_radiance.exp()


def test_an_exported_map_is_used_and_then_not_needed(capture, tmp_path, capfd):
    first, second = train(capture, tmp_path / "first"), tmp_path / "second"
    said = capfd.readouterr().out
    record = read_fits(first, before=10**9)
    assert f"light: {light_summary(mapped_config().light, record)}" in said
    assert [fit.step for fit in record] == sorted({fit.step for fit in record})
    assert len(record) >= 3
    assert read_fits(first, before=record[1].step - 1) == record[:1]

    sky = export_map(first)
    assert read_image(sky).pixels.shape == (6, 12, 3)
    train(capture, second, "--light", sky, "--config.light.environment-height", 9)
    assert "light: the given environment map" in capfd.readouterr().out
    sky.unlink()
    torch.testing.assert_close(radiance_of(second), radiance_of(first), rtol=1e-5, atol=0.0)
    assert load_run(second).config.light.map == str(sky)


def test_a_known_map_without_lamps_is_not_fitted(capture, sky, tmp_path):
    out = train(capture, tmp_path / "run", "--light", sky, "--config.light.kind", "distant")
    run = load_run(out)
    assert isinstance(run.model.light_solver(), NothingToSolve)
    assert read_fits(out, before=10**9) == []
    assert not (out / "light.json").exists()


def test_a_stopped_run_continues_without_the_file(capture, sky, tmp_path):
    """With a checkpoint after every step; the first part of a run stands in for a stopped run."""
    out = train(capture, tmp_path / "run", "--light", sky)
    expected, record = radiance_of(out), read_fits(out, before=10**9)
    stage = checkpoint_path(out, "material_init").read_bytes()
    last_checkpoint(out).write_bytes(stage)
    checkpoint_path(out, "joint").unlink()
    sky.unlink()
    with short_light_fits():
        assert main(["train", "--out", str(out), "--resume", "--device", "cpu"]) == 0
    torch.testing.assert_close(radiance_of(out), expected, rtol=0, atol=0)
    assert read_fits(out, before=10**9) == record  # no duplicates, and the same values


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--light", "none.exr"], "none.exr: no such image"),
        (["--light", "none.png"], "none.png: an environment map is linear radiance in an EXR file"),
        (
            ["--light", "none.exr", "--config.light.kind", "free"],
            "a light that is free at every point takes no map",
        ),
    ],
)
def test_an_invalid_map_is_refused_and_leaves_no_run(
    capture, tmp_path, capfd, monkeypatch, options, complaint
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(PRESETS, "tiny", mapped_config)
    command = ["train", "--data", capture, "--out", tmp_path / "run", "--preset", "tiny", *options]
    refused(capfd, command, complaint, leaves=tmp_path)


# ----------------------------------------------------------------------------------------------------- record

FITS = [LightFit(0, 0.021, 0.004, 204, 3), LightFit(100, -0.001, 0.003, 204, 0)]


def test_the_record_has_the_reason():
    auto = MapLightConfig(kind="auto")
    assert (
        light_summary(auto, FITS)
        == "an environment map without lamps (error +0.1 ± 0.3 % at 204 held-back points with lamps)"
    )
    assert (
        light_summary(auto, FITS[:1])
        == "an environment map and 3 near lamps (error −2.1 ± 0.4 % at 204 held-back points with lamps)"
    )
    given = dataclasses.replace(auto, map="sky.exr")
    assert light_summary(given, [dataclasses.replace(FITS[0], lamps=1)]).startswith(
        "the given environment map and 1 near lamp ("
    )
    assert light_summary(auto, []) == "an environment map"
    assert light_summary(FreeLightConfig(), []) == "a field that is free at every point"


def test_nothing_is_said_of_lamps_from_few_points():
    auto, fit = MapLightConfig(kind="auto"), dataclasses.replace(FITS[1], points=MIN_SAMPLES - 1)
    undecided = "an environment map; lamps were not decided on, with only 19 held-back points"
    assert light_summary(auto, [FITS[0], fit]) == undecided
    enough = dataclasses.replace(fit, points=MIN_SAMPLES)
    assert light_summary(auto, [enough]).startswith("an environment map without lamps (error")


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        '{"format": 2, "fits": []}',
        '{"format": 1, "fits": 3}',
        '{"format": 1, "fits": [3]}',
        '{"format": 1, "fits": [{"step": 1}]}',
        '{"format": 1, "fits": [{"step": "one"}]}',
    ],
)
def test_a_damaged_record_is_refused(tmp_path, text):
    (tmp_path / "light.json").write_text(text)
    with pytest.raises(UserError, match=r"light\.json"):
        read_fits(tmp_path, before=1)


def test_the_record_is_plain_json(tmp_path):
    write_fits(tmp_path, FITS)
    stored = json.loads((tmp_path / "light.json").read_text())
    assert stored["format"] == 1
    assert stored["fits"][0] == dataclasses.asdict(FITS[0])
    assert read_fits(tmp_path, before=101) == FITS


def test_the_initial_light_remains_in_the_record_of_a_resumed_run(tmp_path):
    """The initial light is fitted at the end of a stage, just before the checkpoint of the same step."""
    write_fits(tmp_path, FITS)
    assert read_fits(tmp_path, before=FITS[0].step) == FITS[:1]
    assert read_fits(tmp_path, before=FITS[1].step) == FITS
