"""What `train`, `eval`, `render` and `export` print and write."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import get_args, get_type_hints

import numpy as np
import pytest
import trimesh

from neilfpp_method.cli import main
from neilfpp_method.commands.evaluate import Eval
from neilfpp_method.data.capture import load_capture
from neilfpp_method.data.files.images import read_image
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate import scene_metrics
from neilfpp_method.evaluate.published import PROTOCOLS
from neilfpp_method.train.checkpoint import LAST, last_checkpoint
from tests.data.make_capture import CENTER, RADIUS


def test_train_says_what_it_does_and_leaves_a_run(trained):
    for name in ("config.json", "capture.json", "scene.json", "environment.json", "timing.json"):
        assert json.loads((trained / name).read_text())
    stages = ("sdf_init", "material_init", "joint")
    assert {path.name for path in last_checkpoint(trained).parent.iterdir()} == {
        f"{s}.pt" for s in (LAST, *stages)
    }
    assert {path.name for path in (trained / "previews").iterdir()} == {f"{s}.png" for s in stages}
    assert list(json.loads((trained / "timing.json").read_text())) == list(stages)
    assert list((trained / "tensorboard").iterdir())


def test_eval_writes_flat_finite_figures(trained, tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(scene_metrics, "SURFACE_POINTS", 1000)
    monkeypatch.setattr(scene_metrics, "MESH_RESOLUTION", 32)
    assert main(["eval", str(trained), "--device", "cpu"]) == 0
    said = capfd.readouterr()
    assert said.err == ""
    figures = json.loads((trained / "metrics.json").read_text())
    material = {
        "base_color_psnr",
        "base_color_psnr_gamma",
        "base_color_psnr_scaled",
        "roughness_psnr",
        "metallic_psnr",
    }
    wanted = {"volume_psnr", "pbr_psnr", "normal_mae_deg"} | material | {f"{name}_frame" for name in material}
    assert wanted <= figures.keys()
    assert figures.pop("health") in ("sound", "doubtful", "failed")
    for name, value in figures.items():
        assert isinstance(value, float), name
        assert math.isfinite(value), name
        assert f"{name} " in said.out
    out = tmp_path / "of_a_stage.json"
    assert (
        main(["eval", str(trained), "--device", "cpu", "--checkpoint", "material_init", "--out", str(out)])
        == 0
    )
    assert wanted <= json.loads(out.read_text()).keys()


def test_eval_by_a_published_protocol_has_a_file_of_its_own(trained, capfd):
    before = (trained / "metrics.json").read_bytes() if (trained / "metrics.json").exists() else None
    assert main(["eval", str(trained), "--device", "cpu", "--protocol", "shiny-normals"]) == 0
    written = json.loads((trained / "eval" / "shiny-normals.json").read_text())
    assert (written["protocol"], written["source"]) == ("shiny-normals", "google-research/multinerf eval.py")
    assert 0 < written["figures"]["normal_mae_deg"] < 180
    assert "normal_mae_deg" in capfd.readouterr().out
    assert before == ((trained / "metrics.json").read_bytes() if before else None)
    assert {path.name for path in (trained / "eval").iterdir()} == {"shiny-normals.json"}


def test_every_protocol_can_be_asked_for():
    assert {"neilfpp", *PROTOCOLS} == set(get_args(get_type_hints(Eval)["protocol"]))


def test_render_writes_every_map(trained, tmp_path, capfd):
    assert main(["render", str(trained), "--device", "cpu"]) == 0
    assert capfd.readouterr().err == ""
    out = trained / "renders"
    assert (out / "000.exr").is_file()
    for name in (
        "rgb",
        "rgb_volume",
        "base_color",
        "roughness",
        "metallic",
        "normal",
        "depth",
        "diffuse",
        "specular",
    ):
        assert read_image(out / name / "000.png").pixels.shape[:2] == (18, 24)
    assert (
        main(["render", str(trained), "--device", "cpu", "--views", "all", "--out", str(tmp_path / "all")])
        == 0
    )
    assert len(list((tmp_path / "all").glob("*.exr"))) == 6
    capfd.readouterr()
    (tmp_path / "all" / "000.exr").unlink()
    again = ["render", str(trained), "--device", "cpu", "--out", str(tmp_path / "all"), "--width", "12"]
    assert main([*again, "--views", "all"]) == 0
    kept = "5 of the views exist already and are kept, whatever checkpoint and size they have; --overwrite"
    assert kept in capfd.readouterr().out
    assert main([*again, "--overwrite"]) == 0
    assert "are kept" not in capfd.readouterr().out


def test_export_writes_the_surface_where_it_was_captured(trained, tmp_path, capfd):
    out = tmp_path / "sphere"
    command = [
        "export",
        str(trained),
        "--device",
        "cpu",
        "--resolution",
        "32",
        "--probes",
        "2",
        "--out",
        str(out),
    ]
    assert main(command) == 0
    assert capfd.readouterr().err == ""
    assert {path.name for path in (out / "light").rglob("*.exr")} == {"0000.exr", "0001.exr"}
    mesh = trimesh.load(out / "mesh.ply")
    assert mesh.is_watertight
    assert np.linalg.norm(mesh.centroid - CENTER) < 0.25 * RADIUS
    assert mesh.visual.vertex_colors.shape == (len(mesh.vertices), 4)


def test_a_run_without_a_name_is_named_after_its_capture(capture, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    steps = [f"--config.train.{stage}-steps=1" for stage in ("sdf", "material", "joint")]
    assert main(["train", "--data", str(capture), "--device", "cpu", "--preset=tiny", *steps]) == 0
    assert (tmp_path / "runs" / "sphere-fast" / "config.json").is_file()


@pytest.mark.parametrize("group", ["test", "train"])
def test_a_group_without_views_is_refused(capture, group):
    loaded = load_capture(capture)
    chosen = frozenset() if group == "test" else frozenset(view.name for view in loaded.views)
    with pytest.raises(UserError, match=f"there is no {group} view; give --views all"):
        replace(loaded, test=chosen).chosen_views([group])
