"""`neilfpp export --what asset` from end to end, with a given mesh and with a recovered surface."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from neilfpp_method.cli import main
from neilfpp_method.data.files.images import read_image
from neilfpp_method.export.asset import command as asset_command
from neilfpp_method.export.asset.clean import HOLE
from neilfpp_method.train.run import load_run
from tests.calls import refused, train_tiny, tree
from tests.data.make_capture import CENTER, RADIUS, SCALE, srgb
from tests.export.empty_field import without_surface
from tests.train.small_runs import small_config, solved_light

SMALL = ["--device", "cpu", "--texture-size", "128", "--faces", "400", "--resolution", "32"]
FILES = {"asset.glb", "mesh.ply", "scene.json", "open_in_blender.py", "open_in_mitsuba.py"}
MAPS = {"environment.exr", "environment_blender.exr", "environment_unreal.exr"}


@pytest.fixture(scope="module")
def given(tmp_path_factory, masked_capture) -> Path:
    """A run on a given mesh, with an environment map."""
    out = tmp_path_factory.mktemp("given") / "run"
    return train_tiny(masked_capture, out, "--host", "mesh", config=lambda: solved_light(small_config()))


def test_an_asset_of_a_given_mesh(given, tmp_path, capfd):
    assert (
        main(["export", str(given), "--what", "asset", "--confidence", "--out", str(tmp_path), *SMALL]) == 0
    )
    said = capfd.readouterr()
    assert said.err == ""
    for words in (
        "triangles, which cameras see",
        "simplified: ",
        "charts on",
        f"written to {tmp_path / 'asset'}",
    ):
        assert words in said.out
    out = tmp_path / "asset"
    assert {path.name for path in tmp_path.iterdir()} == {"asset"}
    assert {path.name for path in out.iterdir()} - {"asset.usda"} == FILES | MAPS | {"textures"}
    for name in ("base_color", "metallic_roughness", "roughness", "metallic", "normal", "deviation"):
        assert read_image(out / "textures" / f"{name}.png").pixels.shape[:2] == (128, 128)
    shape = trimesh.load(out / "asset.glb", process=False).geometry["surface"]
    assert len(shape.faces) <= 400
    world = np.array(shape.vertices)[:, [0, 2, 1]] * [1, -1, 1]
    np.testing.assert_allclose(np.linalg.norm(world - CENTER, axis=1), RADIUS, atol=0.04)
    # The texture agrees with the material of the run.
    run = load_run(given)
    row = (1 - shape.visual.uv[:, 1]) * 128 - 0.5
    column = shape.visual.uv[:, 0] * 128 - 0.5
    texel = np.array(shape.visual.material.baseColorTexture)[
        row.round().astype(int), column.round().astype(int)
    ]
    scene = torch.as_tensor((world - CENTER) / SCALE, dtype=torch.float32)
    truth = 255 * srgb(run.model.materials(scene).base_color.detach().numpy())
    assert np.abs(texel - truth).mean() < 2
    described = json.loads((out / "scene.json").read_text())
    assert len(described["cameras"]) == 6
    # The expected errors differ between points, and none is 0.
    deviation = read_image(out / "textures" / "deviation.png").pixels
    assert 0 < deviation.min() < deviation.max()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--texture-size", "32"], ("a texture cannot have 32 texels", "64 to 8192")),
        (["--texture-size", "100000"], ("a texture cannot have 100000 texels",)),
        (["--faces", "3"], ("an asset cannot have 3 triangles", "--faces")),
        (["--error", "-1"], ("--error cannot be -1",)),
        (["--error", "nan"], ("--error cannot be nan",)),
        (["--holes", "-0.1"], ("--holes cannot be -0.1", "scene units")),
        (["--holes", "nan"], ("--holes cannot be nan",)),
        (["--out", "FILE/out"], ("cannot be written",)),
    ],
)
def test_bad_options_are_refused(given, tmp_path, capfd, options, words):
    (tmp_path / "file").write_text("")
    options = [option.replace("FILE", str(tmp_path / "file")) for option in options]
    command = ["export", given, "--what", "asset", "--out", tmp_path / "out", "--device", "cpu", *options]
    refused(capfd, command, *words, leaves=tmp_path)


@pytest.fixture(scope="module")
def found(tmp_path_factory, masked_capture) -> Path:
    """A run with a recovered surface, and a light that is free at every point."""
    return train_tiny(masked_capture, tmp_path_factory.mktemp("found") / "run")


def test_an_error_is_kept_before_the_number_of_triangles(given, tmp_path, capfd):
    """With --faces alone, 100 triangles are what the user gets."""

    def exported(*options: str) -> tuple[int, str]:
        out = tmp_path / str(len(list(tmp_path.iterdir())))
        command = ["export", str(given), "--what", "asset", "--out", str(out), "--device", "cpu", *options]
        assert main([*command, "--texture-size", "512"]) == 0
        shape = trimesh.load(out / "asset" / "asset.glb", process=False).geometry["surface"]
        return len(shape.faces), capfd.readouterr().out

    few, said = exported("--faces", "100")
    assert few <= 100
    assert "to keep the error" not in said
    more, said = exported("--faces", "100", "--error", "0.002")
    assert more > 100
    assert "more than 100 triangles, to keep the error" in said


def test_the_width_of_closed_holes(given, tmp_path, monkeypatch):
    widths = []
    monkeypatch.setattr(asset_command, "clean", lambda full, seen, hole: widths.append(hole) or full)
    command = ["export", str(given), "--what", "asset", "--out", str(tmp_path), *SMALL]
    assert main(command) == 0
    assert main([*command, "--holes", "0.2"]) == 0
    assert widths == [HOLE, 0.2]


def test_an_atlas_that_does_not_fit(found, tmp_path, capfd):
    """The extracted surface is kept for the next try, and nothing else is written."""
    run = shutil.copytree(found, tmp_path / "run")
    command = ["export", run, "--what", "asset", "--device", "cpu", "--resolution", 96, "--error", 0]
    words = ("charts of", "do not fit on a texture of 64×64", "raise --texture-size")
    before = tree(run)
    command = [*command, "--texture-size", 64]
    assert main([*map(str, command)]) == 2
    after = tree(run)
    assert {path.name for path in after.keys() - before.keys()} == {"surface-96.npz"}
    assert {path: after[path] for path in before} == before
    refused(capfd, command, *words, leaves=tmp_path)


def test_a_run_without_a_surface(found, tmp_path, capfd):
    run = without_surface(found, tmp_path / "run")
    command = ["export", run, "--what", "asset", *SMALL]
    refused(capfd, command, "no surface within", "train the stage sdf_init for longer", leaves=tmp_path)


def test_a_run_without_a_material(found, tmp_path, capfd):
    run = shutil.copytree(found, tmp_path / "run")
    command = ["export", run, "--what", "asset", "--checkpoint", "sdf_init", *SMALL]
    refused(capfd, command, "no material at step 4", leaves=tmp_path)
    # A later step has a material, on the recovered surface; the light is free at every point, so there is
    # no map.
    assert main(["export", str(run), "--what", "asset", *SMALL]) == 0
    out = run / "export" / "asset"
    assert {path.name for path in out.iterdir()} - {"asset.usda"} == FILES | {"textures"}
    shape = trimesh.load(out / "asset.glb", process=False).geometry["surface"]
    world = np.array(shape.vertices)[:, [0, 2, 1]] * [1, -1, 1]
    assert np.linalg.norm(world.mean(0) - CENTER) < 0.4 * RADIUS
