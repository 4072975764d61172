"""Findings of real trainings of a few seconds: a surface that is soft to the end or half-way, a dim light."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from neilfpp_method.cli import main
from neilfpp_method.data.files.images import write_exr
from neilfpp_method.health.watch import SURFACE_FROM
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import PRESETS
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.train import quality
from neilfpp_method.train.checkpoint import last_checkpoint
from neilfpp_method.train.health_record import read_findings
from neilfpp_method.train.loop import train
from tests.data.make_capture import make_capture
from tests.scenes import tiny_config
from tests.train.small_runs import short_light_fits, small_training, solved_light

SOFT = {"host.volume.beta_init": 0.1, "host.volume.beta_final": 0.0}
"""A width of the surface that is only learned, with the learning rate of `fast`: it hardly falls."""


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> Path:
    """A ball; geometry starts from its hull. 128 pixels are held back."""
    return make_capture(tmp_path_factory.mktemp("capture") / "ball", size=(64, 48), masks=True)


# -------------------------------------------------------------------------------------------- while it trains


def sdf_init(capture: Path, out: Path, **changes: object):
    """The training of 60 steps of SDF init; the lines that it printed as warnings and as information."""
    steps = {"train.sdf_steps": 60, "train.material_steps": 0, "train.joint_steps": 0}
    run = small_training(capture, out, changed(tiny_config(), {**steps, **changes}))
    said: list[str] = []
    run.watch.say = said.append
    with pytest.MonkeyPatch.context() as patch:
        # Checks at every tenth step, as in a stage of usual length at every tenth of it.
        patch.setattr(quality, "MIN_STEPS", 10)
        patch.setattr(quality, "MAX_SHARE", 1.0)
        train(run)
    return run, run.reporter.said, said


def test_a_surface_that_stays_soft_is_reported_once_at_half_of_sdf_init(capture, tmp_path):
    run, warned, said = sdf_init(capture, tmp_path, **SOFT)
    assert [line[:8] for line in warned] == [f"step {SURFACE_FROM * 60:.0f}:"]
    assert "host.volume.beta_final to 0.002" in warned[0]
    assert said == []
    (finding,) = run.watch.findings.values()
    assert (finding.case, finding.step) == ("beta_stuck", 30)
    # The record tells the width at the end, not that at the first check.
    assert f"{run.model.host.surface_width().item():.2g}" in finding.what
    assert run.watch.health.verdict == "failed"
    assert read_findings(tmp_path) == [finding]


def test_the_remedy_of_a_soft_surface_helps(capture, tmp_path):
    run, warned, _ = sdf_init(capture, tmp_path, **(SOFT | {"host.volume.beta_final": 0.002}))
    assert warned == []
    assert run.watch.health.verdict == "sound"


def test_a_surface_that_becomes_sharp_late_is_reported_and_then_said_to_have_recovered(capture, tmp_path):
    """The bound of β is 0.04 after half of SDF init, 0.02 after two thirds, and 0.005 at its end."""
    # The entering density needs a thinner layer: here the ball would grow beyond its point cloud.
    late = {
        "host.volume.density": "isotropic",
        "host.volume.beta_init": 0.3,
        "host.volume.beta_final": 0.005,
    }
    run, warned, said = sdf_init(capture, tmp_path, **late)
    assert len(warned) == 1
    assert warned[0].startswith("step 30: the surface has not become sharp")
    assert said == ["recovered after step 30: beta_stuck is no longer found"]
    assert run.watch.health.verdict == "sound"


# ------------------------------------------------------------------------------------------------- at its end


def command(capture: Path, out: Path, config: NeilfConfig, *options: object) -> int:
    """The exit status of `neilfpp train --strict` with these settings."""
    words = ["train", "--data", capture, "--out", out, "--device", "cpu", "--preset", "tiny", *options]
    with short_light_fits(), pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, "tiny", lambda: config)
        return main([*map(str, words), "--strict", "--effects", "as-set", "--no-report"])


def test_a_strict_command_ends_with_status_1_if_the_surface_stays_soft_and_keeps_the_run(tmp_path, capfd):
    """Everything else about the two runs is the same."""
    capture = make_capture(tmp_path / "ball", size=(24, 18), masks=True)
    for name, changes, status in (("sharp", {}, 0), ("soft", SOFT, 1)):
        out = tmp_path / name
        assert command(capture, out, changed(tiny_config(), changes)) == status
        record = json.loads((out / "health.json").read_text())
        assert [finding["case"] for finding in record["findings"]] == ["beta_stuck"] * status
        assert record["verdict"] == ("failed" if status else "sound")
        assert last_checkpoint(out).is_file()
        said = capfd.readouterr().err
        assert ("the surface has not become sharp" in said) if status else not said


def test_a_light_that_is_far_too_dim_is_worse_than_one_color(capture, tmp_path):
    """One colour has 13.1 dB, the rendering 5.2 dB under a hundredth of a bright light."""
    quick = {"optimizer.brdf": 0.1, "train.sdf_steps": 2, "train.material_steps": 30, "train.joint_steps": 0}
    # Light that is the same from all directions says nothing of the roughness, so there is none.
    known = {"light.kind": "distant", "light.inter_reflection": "off", "shading.specular": False}
    config = changed(solved_light(tiny_config()), {**quick, **known})
    for radiance, status in ((3.0, 0), (0.03, 1)):
        sky, out = tmp_path / f"{radiance}.exr", tmp_path / f"{radiance}"
        write_exr(sky, {"RGB": np.full((4, 8, 3), radiance, np.float32)})
        assert command(capture, out, config, "--light", sky) == status
        severe = {finding.case: finding.severe for finding in read_findings(out)}
        expected = {"worse_than_constant": True, "material_at_bounds": True}
        assert severe == (expected if status else {})
