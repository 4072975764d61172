"""`ns-train neilfpp` through all three stages, and the commands that follow it, on a reduced table top."""

from __future__ import annotations

import dataclasses
import gzip
import json
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from nerfstudio.engine.callbacks import TrainingCallbackAttributes
from nerfstudio.scripts.eval import ComputePSNR
from nerfstudio.scripts.render import DatasetRender
from nerfstudio.utils.eval_utils import eval_setup

from neilfpp_method.data.files.images import write_exr
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.protocols import evaluate
from neilfpp_method.kernels.process import computing_fast
from neilfpp_method.plugin.outputs import mean_incident_light
from neilfpp_method.schedule import STAGES, Stage, stage_steps
from neilfpp_method.settings.presets import fixed_geometry, free_light
from neilfpp_method.settings.types import NeilfConfig
from neilfpp_method.structures import Maps, RayBatch
from neilfpp_method.train.loop import train
from neilfpp_method.train.run import Run
from tests.data.make_capture import make_capture
from tests.train.small_runs import differences, small_training
from tests_nerfstudio.runs import (
    TEST,
    checkpoint,
    ns_train,
    reduced_tabletop,
    small_settings,
    trainer_config,
    weights,
    with_steps,
)

# The part of the model for each field of the loss table.
FIELDS = {
    "geometry": "host.sdf_field.",
    "beta": "host.density.",
    "radiance": "host.radiance_field.",
    "background": "host.background.",
    "brdf": "brdf.",
    "light": "light.",
}
SETTINGS = small_settings()
# L_ref on many rays, so that every step has some that hit.
FREE = free_light(SETTINGS)
FREE = dataclasses.replace(FREE, light=dataclasses.replace(FREE.light, rays_per_point=4.0))


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return reduced_tabletop(tmp_path_factory.mktemp("tabletop"))


@pytest.fixture(scope="module")
def run(data: Path, tmp_path_factory) -> Path:
    return ns_train(trainer_config(data, tmp_path_factory.mktemp("run"), SETTINGS))


def train_for(data: Path, out: Path, iterations: int, settings: NeilfConfig = SETTINGS) -> Path:
    config = trainer_config(data, out, settings)
    config.max_num_iterations = iterations
    return ns_train(config)


# --------------------------------------------------------------------------------------------------- training


@pytest.mark.parametrize("settings", [SETTINGS, FREE], ids=["solved light", "free light"])
def test_each_stage_trains_only_its_fields(data: Path, tmp_path: Path, settings: NeilfConfig) -> None:
    after_steps = {n: weights(train_for(data, tmp_path / str(n), n, settings)) for n in (1, 3, 4, 8, 12)}
    # Light and material get their initial values at the end of SDF init, after four steps.
    for stage, (first, last) in zip(Stage, ((1, 3), (4, 8), (8, 12)), strict=True):
        before, after = after_steps[first], after_steps[last]
        for field, prefix in FIELDS.items():
            changed = any(
                bool(differences(before[key], after[key])) for key in before if key.startswith(prefix)
            )
            there = any(key.startswith(prefix) for key in before)
            assert changed == (there and field in STAGES[stage].trains), (stage, field)


@pytest.mark.parametrize("kind", ["auto", "distant_near"])
def test_a_resumed_run_ends_like_an_uninterrupted_one(data: Path, tmp_path: Path, kind: str) -> None:
    settings = dataclasses.replace(SETTINGS, light=dataclasses.replace(SETTINGS.light, kind=kind))
    whole = ns_train(trainer_config(data, tmp_path / "whole", settings))
    # The light is fitted at steps 4, 7 and 10; the memory for the next fit is half full here.
    first = train_for(data, tmp_path / "first", 6, settings)
    config = trainer_config(data, tmp_path / "second", settings)
    config.load_dir = first / "nerfstudio_models"
    # Nerfstudio would run the same number of iterations again; training must end with the last stage.
    second = ns_train(config)
    assert differences(checkpoint(whole)["pipeline"], checkpoint(second)["pipeline"]) == []
    assert differences(checkpoint(whole)["optimizers"], checkpoint(second)["optimizers"]) == []
    before, after = weights(first), weights(second)
    assert differences(before["light.log_radiance"], after["light.log_radiance"]), "it was solved for again"
    if kind == "distant_near":
        assert before["lamps._extra_state"]["count"] > 0, "there were lamps to be saved"


def test_a_known_map_is_read_once_and_then_part_of_the_run(data: Path, tmp_path: Path) -> None:
    file, radiance = (
        tmp_path / "map.exr",
        np.random.default_rng(0).uniform(0.5, 2.0, (6, 12, 3)).astype(np.float32),
    )
    write_exr(file, {"RGB": radiance})
    settings = dataclasses.replace(SETTINGS, light=dataclasses.replace(SETTINGS.light, map=str(file)))
    first = train_for(data, tmp_path / "first", 6, settings)
    file.unlink()
    config = trainer_config(data, tmp_path / "second", settings)
    config.load_dir = first / "nerfstudio_models"
    for run in (first, ns_train(config)):
        _, pipeline, _, _ = eval_setup(run / "config.yml")
        shown = pipeline.model.neilf.light.log_radiance.exp().permute(1, 2, 0)
        np.testing.assert_allclose(shown.numpy(), radiance, rtol=1e-5)


@pytest.mark.parametrize("settings", [SETTINGS, FREE], ids=["solved light", "free light"])
def test_the_same_scene_seed_and_steps_give_the_same_weights_in_both_loops(
    data: Path, tmp_path: Path, settings: NeilfConfig
) -> None:
    inside = ns_train(trainer_config(data, tmp_path / "inside", settings))
    standalone = small_training(data, tmp_path / "standalone", settings, patches=0)
    with computing_fast():
        train(standalone)
    assert differences(weights(inside), dict(standalone.model.state_dict())) == []


def test_the_same_scene_seed_and_steps_give_the_same_quality_in_both_loops(
    data: Path, tmp_path: Path
) -> None:
    settings = with_steps(SETTINGS, sdf_steps=60, material_steps=20, joint_steps=5)
    ns = evaluated(ns_train(trainer_config(data, tmp_path / "inside", settings)), tmp_path)
    standalone = small_training(data, tmp_path / "standalone", settings, patches=0)
    with computing_fast():
        train(standalone)
    capture, steps = standalone.pixels.capture, sum(stage_steps(settings.train).values())
    own = evaluate(Run(tmp_path, settings, capture, standalone.model.facts, standalone.model.eval(), steps))
    for theirs, ours in {"psnr": "pbr_psnr", "volume_psnr": "volume_psnr"}.items():
        assert own[ours] > 10.0, "something was learnt, or there is nothing to compare"
        # The weights are the same; the rays of nerfstudio's evaluation differ only by rounding.
        assert ns[theirs] == pytest.approx(own[ours], abs=0.05), theirs


@pytest.mark.parametrize(("settings", "descends"), [(SETTINGS, {"brdf"}), (FREE, {"brdf", "light"})])
def test_on_a_given_mesh_only_material_and_light_are_trained(
    tmp_path: Path, settings: NeilfConfig, descends: set[str]
) -> None:
    tiny = fixed_geometry(settings)
    settings = dataclasses.replace(tiny, radiance=dataclasses.replace(tiny.radiance, layers=1, width=16))
    settings = with_steps(settings, sdf_steps=0, material_steps=2, joint_steps=0)
    run = ns_train(
        trainer_config(make_capture(tmp_path / "capture"), tmp_path / "run", settings, method="neilfpp-mesh")
    )
    moved = {key.split(".")[0] for key in weights(run)}
    assert {"brdf", "light", "host"} <= moved
    assert set(checkpoint(run)["optimizers"]) == {"radiance", *descends}
    assert checkpoint(run)["step"] == 1


def test_several_devices_are_refused(data: Path, tmp_path: Path) -> None:
    config = trainer_config(data, tmp_path, SETTINGS)
    config.pipeline.datamanager.data = data
    model = config.pipeline.setup(device="cpu").model
    with pytest.raises(UserError, match="one device"):
        model.get_training_callbacks(
            TrainingCallbackAttributes(None, None, None, SimpleNamespace(world_size=2))
        )


# ----------------------------------------------------------------------------------------- the commands after


def evaluated(run: Path, out: Path) -> dict[str, float]:
    ComputePSNR(
        load_config=run / "config.yml", output_path=out / "eval.json", render_output_path=out / "eval"
    ).main()
    return json.loads((out / "eval.json").read_text())["results"]


def test_ns_eval_measures_the_test_views_and_writes_all_maps(run: Path, tmp_path: Path) -> None:
    figures = evaluated(run, tmp_path)
    assert {"psnr", "ssim", "volume_psnr", "volume_ssim"} <= set(figures)
    assert np.isfinite(list(figures.values())).all()
    maps = {path.stem.removeprefix("eval_").rsplit("_", 1)[0] for path in (tmp_path / "eval").iterdir()}
    assert {"img", "base_color", "roughness", "metallic", "incident_light", "normal", "depth"} <= maps


def test_ns_render_writes_material_maps_as_raw_floats(run: Path, tmp_path: Path) -> None:
    names = ["raw-roughness", "raw-base_color", "raw-incident_light", "raw-rgb", "raw-normal", "base_color"]
    DatasetRender(load_config=run / "config.yml", output_path=tmp_path, rendered_output_names=names).main()
    _, pipeline, _, _ = eval_setup(run / "config.yml")
    for i, (camera, _) in enumerate(pipeline.datamanager.fixed_indices_eval_dataloader):
        expected = pipeline.model.get_outputs_for_camera(camera)
        for name in names[:5]:
            with gzip.open(tmp_path / "test" / name / f"{TEST[i]:03d}.npy.gz") as file:
                values = np.load(file)
            assert values.dtype == np.float32
            np.testing.assert_array_equal(values, expected[name.removeprefix("raw-")].numpy())
        hit = expected["roughness"][..., 0] > 0.0
        assert hit.any()
        assert (expected["base_color"][hit] > 0.0).all()
        assert (expected["incident_light"][hit] > 0.0).all()
        assert not expected["incident_light"][~hit].any()
    assert (tmp_path / "test" / "base_color").is_dir()


def test_before_the_material_stage_no_material_is_shown(data: Path, tmp_path: Path) -> None:
    run = train_for(data, tmp_path, 3)
    _, pipeline, _, _ = eval_setup(run / "config.yml")
    camera, _ = pipeline.datamanager.next_eval_image(0)
    outputs = pipeline.model.get_outputs_for_camera(camera)
    assert torch.equal(outputs["rgb"], outputs["rgb_volume"])
    for name in ("base_color", "roughness", "incident_light"):
        assert not outputs[name].any()


def test_figures_count_valid_pixels_of_the_object(run: Path) -> None:
    _, pipeline, _, _ = eval_setup(run / "config.yml")
    model = pipeline.model
    image = torch.full((12, 12, 3), 0.5)
    objects, valid, opacity = (torch.zeros(12, 12, 1, dtype=torch.bool) for _ in range(3))
    objects[:8], valid[:, :8], opacity[4:] = True, True, True

    def psnr(known: bool, wrong: torch.Tensor) -> float:
        facts = {
            "object_mask": objects.float(),
            "mask_known": torch.full((12, 12, 1), float(known)),
            "valid": valid,
        }
        shown = torch.where(wrong, 0.25, image)
        outputs = {name: shown for name in ("rgb", "rgb_volume", "normal", "base_color", "incident_light")}
        outputs |= {name: opacity.float() for name in ("accumulation", "depth", "roughness", "metallic")}
        return model.get_image_metrics_and_images(outputs, {"image": image, **facts})[0]["psnr"]

    nothing = torch.zeros_like(valid)
    for known, counted in ((True, objects & valid), (False, opacity & valid)):
        assert psnr(known, ~counted) == psnr(known, nothing) > 60.0
        # A quarter of the pixels that count: 6 dB above the error of all of them.
        share = counted & (torch.arange(12).view(1, 12, 1) < 2)
        assert psnr(known, share) == pytest.approx(psnr(known, counted) + 10 * np.log10(4.0), abs=1e-3)


def test_light_on_a_wall_is_its_irradiance_over_pi(run: Path, monkeypatch) -> None:
    _, pipeline, _, _ = eval_setup(run / "config.yml")
    model = pipeline.model
    monkeypatch.setattr(
        model.neilf, "incident_light", lambda x, wi: wi[..., 2:].clamp_min(0.0).expand(-1, -1, 3)
    )
    up = torch.tensor([[0.0, 0.0, 1.0]])
    one, three = torch.ones(1, 1), torch.ones(1, 3)
    maps = Maps(three, three, three, three, three, one, one, up, one, one)
    light = mean_incident_light(model.neilf, RayBatch(2.0 * up, -up), maps)
    # ∫ cos θ · cos θ dω over the hemisphere is 2π/3; a lattice of 8 directions is close to it.
    torch.testing.assert_close(light, torch.full((1, 3), 2.0 / 3.0), atol=0.05, rtol=0)
