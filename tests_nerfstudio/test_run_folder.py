"""The run folder that `ns-train neilfpp` writes beside its `config.yml`, and this package's commands on
it.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from neilfpp_method.cli import main
from neilfpp_method.data.files.images import read_image, write_exr
from neilfpp_method.health.cases import verdict_of
from neilfpp_method.plugin.model import NeilfMethod
from neilfpp_method.plugin.steps import Steps
from neilfpp_method.schedule import Stage
from neilfpp_method.structures import LossTerms, PixelBatch
from neilfpp_method.train.checkpoint import last_checkpoint, load_checkpoint, load_weights
from neilfpp_method.train.health_record import read_findings
from neilfpp_method.train.rerun import rerun_step
from neilfpp_method.train.run import load_run, run_folder
from neilfpp_method.train.skipped import load_step
from tests.data.make_capture import make_capture
from tests.train.small_runs import differences
from tests_nerfstudio.runs import ns_train, small_settings, trainer_config, weights


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return make_capture(tmp_path_factory.mktemp("capture"), size=(16, 12), test=(0, 1))


@pytest.fixture(scope="module")
def run(data: Path, tmp_path_factory) -> Path:
    return ns_train(trainer_config(data, tmp_path_factory.mktemp("run"), small_settings()))


def test_the_run_folder_holds_the_weights_of_the_checkpoint(run: Path) -> None:
    loaded = load_run(run_folder(run / "config.yml"))
    assert loaded.step == 12
    assert differences(weights(run), dict(loaded.model.state_dict())) == []


def test_the_commands_accept_the_configuration(run: Path, tmp_path: Path) -> None:
    config, results = str(run / "config.yml"), run / "neilfpp"
    assert main(["export", config, "--what", "mesh", "--resolution", "32"]) == 0
    assert main(["eval", config]) == 0
    assert main(["report", config, "--views", "1"]) == 0
    assert (results / "export" / "mesh.ply").stat().st_size > 1000
    assert json.loads((results / "metrics.json").read_text())
    assert "base colour" in (results / "report.html").read_text().lower()

    # Twice the light gives twice the radiance, from the same random numbers.
    sky, pictures = np.full((6, 12, 3), 0.5, np.float32), []
    for name, gain in (("dim", 1.0), ("bright", 2.0)):
        write_exr(tmp_path / f"{name}.exr", {"RGB": gain * sky})
        options = ["--env", str(tmp_path / f"{name}.exr"), "--spp", "2", "--resolution", "32"]
        assert main(["relight", config, *options]) == 0
        files = sorted((results / "relit" / name).rglob("*.exr"))
        assert len(files) == 2, "the two test views"
        pictures.append(np.stack([read_image(file).pixels for file in files]))
    assert pictures[0].max() > 0.0
    np.testing.assert_allclose(pictures[1], 2.0 * pictures[0], rtol=0.01, atol=1e-4)


def test_a_configuration_without_a_run_folder_is_refused(tmp_path: Path, capsys) -> None:
    (tmp_path / "config.yml").write_text("")
    assert main(["export", str(tmp_path / "config.yml")]) == 2
    assert "no run folder neilfpp/ beside it" in capsys.readouterr().err


def test_a_training_begun_in_nerfstudio_is_continued_outside(data: Path, run: Path, tmp_path: Path) -> None:
    config = trainer_config(data, tmp_path, small_settings())
    config.max_num_iterations = 6
    first = ns_train(config) / "neilfpp"
    assert load_checkpoint(last_checkpoint(first))["step"] == 6
    assert main(["train", "--out", str(first), "--resume", "--no-report"]) == 0
    continued = load_checkpoint(last_checkpoint(first))["model"]
    assert differences(weights(run), continued) == []


def test_health_is_checked(run: Path) -> None:
    for folder in (run, run / "neilfpp"):
        findings = read_findings(folder)
        assert findings is not None
        # The light is fitted to 48 points.
        assert "few_light_points" in [finding.case for finding in findings]
        assert json.loads((folder / "health.json").read_text())["verdict"] == verdict_of(findings)


def test_a_step_that_is_not_finite_is_skipped_and_can_be_repeated(
    data: Path, tmp_path: Path, capsys, monkeypatch
) -> None:
    compute, losses, terms = Steps.compute, NeilfMethod.get_loss_dict, {}

    def kept_terms(self: Steps, pixels: PixelBatch) -> LossTerms:
        computed = compute(self, pixels)
        if self.number == 6:
            terms.update({name: term.values.detach() for name, term in computed.items()})
        return computed

    def spoilt(self: NeilfMethod, *arguments: object) -> dict[str, torch.Tensor]:
        weighted = losses(self, *arguments)
        spoils = self.training and self.steps.number == 6
        return {name: torch.nan * loss for name, loss in weighted.items()} if spoils else weighted

    monkeypatch.setattr(Steps, "compute", kept_terms)
    monkeypatch.setattr(NeilfMethod, "get_loss_dict", spoilt)
    ended = ns_train(trainer_config(data, tmp_path, small_settings()))
    said = " ".join(capsys.readouterr().out.split())
    assert "step 6 skipped: the gradient of" in said
    assert "(1 skipped so far); see neilfpp replay" in said
    kept = weights(ended)
    assert all(value.isfinite().all() for value in kept.values() if isinstance(value, torch.Tensor))

    skipped, model = load_step(ended / "neilfpp", 6), load_run(ended / "neilfpp").model
    assert skipped.stage is Stage.MATERIAL_INIT
    load_weights(model, skipped.model, ended)
    model.train().freeze_for(skipped.stage)
    torch.set_rng_state(skipped.random)
    repeated = model.step(skipped.batch, skipped.stage).terms
    for name, values in terms.items():
        torch.testing.assert_close(repeated[name].values.detach(), values, msg=name)
    assert rerun_step(ended / "neilfpp", 6).finite, "the fault was outside of the step"
