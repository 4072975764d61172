"""`neilfpp relight` from end to end on tiny runs, with a recovered surface and with a given mesh."""

from __future__ import annotations

import json
import resource
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from neilfpp_method.cli import COMMANDS, main
from neilfpp_method.commands.command import Command
from neilfpp_method.data.files.images import read_image, write_exr, write_png
from neilfpp_method.export import surface_cache
from neilfpp_method.relight import command
from neilfpp_method.relight.lamplight import Lamplight
from neilfpp_method.train.checkpoint import last_checkpoint
from tests.calls import train_tiny
from tests.train.small_runs import few_steps, solved_light

FEW = ("--spp", "4", "--resolution", "32", "--device", "cpu")


@pytest.fixture(scope="module")
def found(tmp_path_factory, masked_capture) -> Path:
    """A run with a recovered surface and an environment map."""
    out = tmp_path_factory.mktemp("runs") / "found"
    return train_tiny(masked_capture, out, config=lambda: solved_light(few_steps()))


@pytest.fixture(scope="module")
def given(tmp_path_factory, masked_capture) -> Path:
    """A run with the capture's mesh and a light that is free at every point."""
    return train_tiny(
        masked_capture, tmp_path_factory.mktemp("runs") / "given", "--host", "mesh", config=few_steps
    )


@pytest.fixture(scope="module")
def sky(tmp_path_factory) -> Path:
    """Light from +x, and a little from all directions."""
    radiance = np.full((8, 16, 3), 0.2, np.float32)
    radiance[3:5, 3:5] = (8.0, 4.0, 2.0)
    path = tmp_path_factory.mktemp("light") / "studio.exr"
    write_exr(path, {"RGB": radiance})
    return path


def relit(run: Path, *options: object) -> int:
    return main(["relight", str(run), *FEW, *map(str, options)])


def files(run: Path) -> set[Path]:
    """Everything in a run, without the surfaces that are kept for later commands."""
    return {path for path in run.rglob("*") if "cache" not in path.relative_to(run).parts}


def refused(capfd, run: Path, *options: object, words: tuple[str, ...]) -> None:
    before = files(run)
    capfd.readouterr()
    assert relit(run, *options) == 2
    said = capfd.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith("error: ")
    for word in words:
        assert word in said
    assert files(run) == before


@pytest.mark.parametrize("which", ["found", "given"])
def test_a_run_under_another_light(request, sky, which, capfd):
    run = request.getfixturevalue(which)
    assert relit(run, "--env", sky) == 0
    assert capfd.readouterr().err == ""
    folder = run / "relit" / "studio"
    assert {path.name for path in folder.iterdir()} == {"000.exr", "000.png", "000.json"}
    image = read_image(folder / "000.exr")
    assert image.pixels.shape == (18, 24, 3)
    covered = image.alpha == 1
    assert 0.05 < covered.mean() < 0.9
    assert (image.pixels[covered] > 0).all()
    assert not image.pixels[image.alpha == 0].any()
    shown = read_image(folder / "000.png")
    np.testing.assert_allclose(shown.alpha, image.alpha, atol=0.003)
    made = json.loads((folder / "000.json").read_text())
    assert made["map"] == "studio.exr"
    assert made["samples"] == 4
    assert not made["lamps"]


def test_the_light_comes_from_the_direction_in_the_map(given, sky, tmp_path):
    """The mesh is a ball: one half of it faces the sun at +x, and after a rotation by 180° the other half."""
    means = {}
    for turn in (0, 180):
        out = tmp_path / str(turn)
        assert (
            relit(given, "--env", sky, "--rotate", turn, "--views", "turntable", "--frames", 2, "--out", out)
            == 0
        )
        means[turn] = [read_image(out / "studio" / f"turn_000{k}.exr").pixels.mean() for k in (0, 1)]
    # The first camera is at +x, the second at −x.
    assert means[0][0] > 1.5 * means[0][1]
    assert means[180][1] > 1.5 * means[180][0]
    film = cv2.VideoCapture(str(tmp_path / "0" / "studio" / "turntable.mp4"))
    assert film.get(cv2.CAP_PROP_FRAME_COUNT) == 2
    assert (film.get(cv2.CAP_PROP_FRAME_WIDTH), film.get(cv2.CAP_PROP_FRAME_HEIGHT)) == (24, 18)


def test_the_own_light_includes_the_lamps(found):
    assert relit(found, "--scale", 0.5) == 0
    made = json.loads((found / "relit" / "own" / "000.json").read_text())
    assert made["lamps"]
    assert made["width"] == 12


def test_the_surface_is_extracted_once_and_the_picture_is_the_same(found, tmp_path, monkeypatch):
    shutil.rmtree(found / "cache", ignore_errors=True)
    assert relit(found, "--scale", 0.5, "--out", tmp_path / "first") == 0
    monkeypatch.setattr(surface_cache, "extract_mesh", lambda *_, **__: pytest.fail("extracted again"))
    monkeypatch.setattr(surface_cache, "shading_normals", lambda *_: pytest.fail("normals computed again"))
    assert relit(found, "--scale", 0.5, "--out", tmp_path / "second") == 0
    first, second = (read_image(tmp_path / name / "own" / "000.exr") for name in ("first", "second"))
    assert np.array_equal(first.pixels, second.pixels)
    assert np.array_equal(first.alpha, second.alpha)


def test_a_damaged_surface_is_extracted_again_with_a_line(found, tmp_path, capfd):
    assert relit(found, "--scale", 0.5, "--out", tmp_path / "first") == 0
    (found / "cache" / "surface-32.npz").write_bytes(b"PK")
    capfd.readouterr()
    assert relit(found, "--scale", 0.5, "--out", tmp_path / "second") == 0
    said = capfd.readouterr()
    assert said.err == ""
    assert said.out.count("surface-32.npz: damaged (") == 1


def test_existing_images_are_not_rendered_again(given, sky, tmp_path, capfd):
    options = ("--env", sky, "--out", tmp_path)
    assert relit(given, *options) == 0
    picture = tmp_path / "studio" / "000.exr"
    before = picture.stat().st_mtime_ns
    assert relit(given, *options) == 0
    assert picture.stat().st_mtime_ns == before
    capfd.readouterr()
    assert relit(given, *options, "--rotate", 90) == 2
    assert "rotate 0.0, not 90.0" in capfd.readouterr().err
    assert picture.stat().st_mtime_ns == before
    assert relit(given, *options, "--rotate", 90, "--force") == 0
    assert picture.stat().st_mtime_ns > before
    # An image without a record is unfinished.
    picture.with_suffix(".json").unlink()
    before = picture.stat().st_mtime_ns
    assert relit(given, *options, "--rotate", 90) == 0
    assert picture.stat().st_mtime_ns > before


def test_the_default_number_of_samples_is_the_same_setting_as_that_number(given, sky, tmp_path, monkeypatch):
    options = ["--env", str(sky), "--out", str(tmp_path), "--resolution", "32", "--device", "cpu"]
    monkeypatch.setattr("neilfpp_method.relight.request.SAMPLES", 3)
    assert main(["relight", str(given), *options]) == 0
    record = tmp_path / "studio" / "000.json"
    assert json.loads(record.read_text())["spp"] == 3
    before = record.stat().st_mtime_ns
    assert main(["relight", str(given), *options, "--spp", "3"]) == 0
    assert record.stat().st_mtime_ns == before
    # With a time limit there is no default.
    assert main(["relight", str(given), *options, "--seconds", "0.1", "--force"]) == 0
    assert json.loads(record.read_text())["spp"] is None


def test_views_are_selected_by_name(given, sky, tmp_path):
    assert relit(given, "--env", sky, "--out", tmp_path, "--views", "002", "000") == 0
    assert {path.stem for path in (tmp_path / "studio").iterdir()} == {"000", "002"}


def test_another_map_with_the_same_name_is_detected(given, sky, tmp_path, capfd):
    options = ("--width", 6, "--out", tmp_path / "out", "--env")
    assert relit(given, *options, sky) == 0
    write_exr(tmp_path / sky.name, {"RGB": np.ones((8, 16, 3), np.float32)})
    capfd.readouterr()
    assert relit(given, *options, tmp_path / sky.name) == 2
    said = capfd.readouterr().err
    assert "another map of this name" in said
    assert "sha256" not in said


def test_images_of_another_run_are_not_taken_for_its_own(given, sky, tmp_path, capfd):
    options = ("--env", sky, "--width", 6, "--out", tmp_path / "out")
    assert relit(given, *options) == 0
    shutil.copytree(given, tmp_path / "other")
    weights = last_checkpoint(tmp_path / "other")
    saved = torch.load(weights, weights_only=True)
    saved["model"] = {
        name: value + 1 if name.startswith("brdf") else value for name, value in saved["model"].items()
    }
    torch.save(saved, weights)
    capfd.readouterr()
    assert relit(tmp_path / "other", *options) == 2
    assert "the weights of another training" in capfd.readouterr().err
    assert relit(tmp_path / "other", *options, "--force") == 0


def test_an_edit_changes_the_image(given, sky, tmp_path):
    def mean(name: str, *options: object) -> np.ndarray:
        assert relit(given, "--env", sky, "--out", tmp_path / name, *options) == 0
        return read_image(tmp_path / name / "studio" / "000.exr").pixels.mean((0, 1))

    # The ball has its centre at (0.3, −0.2, 0.5) and the radius 1.2; the box meets its lowest point only.
    beside_it = (0.2, -0.3, -0.75, 0.4, -0.1, -0.69)
    red = mean("red", "--set", "base_color=0.9,0.05,0.05", "--set", "roughness=1")
    black = mean("black", "--set", "base_color=0", "--set", "roughness=1", "--set", "metallic=1")
    beside = mean("beside", "--set", "base_color=0", "--set", "metallic=1", "--box", *beside_it)
    assert red[0] / red[2] > 6
    assert black.max() < 0.2 * red[0]
    assert beside.min() > 2 * black.max()


def test_an_edit_within_a_painted_mask(given, sky, tmp_path):
    """The left half of a view becomes black and the right half is unchanged; the random numbers depend only
    on the view.
    """
    options = ("--env", sky, "--spp", "8", "--set", "base_color=0", "--set", "metallic=1", "--bounces", 1)
    assert relit(given, "--env", sky, "--spp", "8", "--bounces", 1, "--out", tmp_path / "plain") == 0
    white = np.zeros((18, 24, 1), np.uint8)
    white[:, :12] = 255
    write_png(tmp_path / "000.png", white)
    assert relit(given, *options, "--mask", tmp_path / "000.png", "--out", tmp_path / "masked") == 0
    plain, masked = (read_image(tmp_path / name / "studio" / "000.exr") for name in ("plain", "masked"))
    inside = plain.alpha == 1
    assert masked.pixels[:, :11][inside[:, :11]].max() < 0.2 * plain.pixels[:, :11][inside[:, :11]].mean()
    np.testing.assert_allclose(masked.pixels[:, 13:], plain.pixels[:, 13:], rtol=1e-5)


def test_lamps_are_moved_and_removed(given, sky, tmp_path, monkeypatch):
    """A lamp behind the ball does not light the part that the first view shows; moved to the camera, it
    does.
    """
    behind = Lamplight(
        torch.tensor([[-1.5, 0.0, 0.0]]), torch.zeros(1, 3), torch.full((1, 3), 900.0), radius=0.05
    )
    monkeypatch.setattr(command, "lamps_of_run", lambda lamps: behind)

    def mean(name: str, *options: object) -> float:
        assert relit(given, "--env", sky, "--out", tmp_path / name, *options) == 0
        made = json.loads((tmp_path / name / "studio" / "000.json").read_text())
        assert made["lamps"] == (name != "without")
        return float(read_image(tmp_path / name / "studio" / "000.exr").pixels.mean())

    without, kept = mean("without"), mean("kept", "--lamps", "keep")
    moved, off = mean("moved", "--lamp", "0=2.7,-0.2,1.1"), mean("off", "--lamp", "0=off")
    assert kept == pytest.approx(without, rel=0.02)
    assert off == pytest.approx(without, rel=1e-6)
    assert moved > 1.5 * without


def test_figures_against_true_images(given, sky, tmp_path, capfd):
    assert relit(given, "--env", sky, "--out", tmp_path / "one") == 0
    relit_view = read_image(tmp_path / "one" / "studio" / "000.exr")
    write_exr(tmp_path / "truth" / "000.exr", {"RGB": 0.5 * relit_view.pixels})
    capfd.readouterr()
    assert relit(given, "--env", sky, "--out", tmp_path / "one", "--truth", tmp_path / "truth") == 0
    assert "studio: PSNR" in capfd.readouterr().out
    figures = json.loads((tmp_path / "one" / "studio" / "metrics.json").read_text())
    assert figures["relight_psnr_scaled"] > 90
    assert figures["relight_psnr"] < 40
    assert figures["scale"] == pytest.approx([0.5, 0.5, 0.5], rel=1e-4)
    assert figures["mask_source"] == "true depth"
    assert figures["views"]["000"] > 90


def test_true_images_have_the_size_of_the_files(masked_capture, given, sky, tmp_path):
    """The images of a run that was trained at half the size are compared at full size."""
    half = train_tiny(masked_capture, tmp_path / "half", "--host", "mesh", "--scale", "0.5", config=few_steps)
    assert relit(given, "--env", sky, "--out", tmp_path / "full") == 0
    truth = tmp_path / "full" / "studio"
    assert relit(half, "--env", sky, "--truth", truth) == 0
    figures = json.loads((half / "relit" / "studio" / "metrics.json").read_text())
    assert figures["relight_psnr_scaled"] > 20
    assert read_image(half / "relit" / "studio" / "000.exr").pixels.shape == (18, 24, 3)


def test_the_map_behind_the_surface(given, sky, tmp_path):
    assert relit(given, "--env", sky, "--background", "map", "--out", tmp_path) == 0
    image = read_image(tmp_path / "studio" / "000.exr")
    assert image.alpha is None
    assert image.pixels.min() > 0
    assert image.pixels[0, 0].max() >= 0.19


def test_a_time_per_view_is_kept(given, sky, tmp_path):
    command = [
        "relight",
        str(given),
        "--env",
        str(sky),
        "--seconds",
        "0.2",
        "--out",
        str(tmp_path),
        "--device",
        "cpu",
    ]
    assert main(command) == 0
    made = json.loads((tmp_path / "studio" / "000.json").read_text())
    assert made["samples"] >= 1
    assert made["took"] < 20


# -------------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--env", "missing.exr"], ("missing.exr", "no such image")),
        (["--spp", "0"], ("--spp is 0",)),
        (["--resolution", "0"], ("0 cells per side", "give 8 to 2048")),
        (["--resolution", "100000"], ("100000 cells per side", "give 8 to 2048")),
        (["--bounces", "100"], ("--bounces is 100",)),
        (["--scale", "0.5", "--width", "10"], ("--scale and --width",)),
        (["--set", "gloss=1"], ("gloss=1", "roughness")),
        (["--box", "0", "0", "0", "1", "1", "1"], ("--box without --set",)),
        (["--set", "metallic=1", "--box", "0", "0", "0", "1", "1", "0"], ("--box has no inside",)),
        (["--mask", "000.png"], ("--mask without --set",)),
        (["--set", "metallic=1", "--mask", "000.png"], ("000.png", "no such image")),
        (["--set", "metallic=1", "--mask", "nobody.png"], ("no view 'nobody'",)),
        (["--lamp", "7=off"], ("--lamp 7", "no such lamp")),
        (["--lamp", "0=up"], ("--lamp 0=up", "x,y,z")),
        (["--lamp", "0=off", "--lamps", "drop"], ("--lamps drop",)),
        (["--views", "turntable", "--frames", "1"], ("1 frames",)),
        (["--views", "turntable", "--frames", "0"], ("0 frames",)),
        (["--frames", "12"], ("--frames without --views turntable",)),
        (["--width", "100000"], ("100000×75000",)),
        (["--views", "turntable", "--truth", "x"], ("true images",)),
        (["--views", "nobody"], ("no view 'nobody'", "000")),
        (["--views", "turntable", "000"], ("--views turntable",)),
        (["--checkpoint", "sdf_init"], ("no material",)),
        (
            ["--set", "metallic=1", "--box", "90", "90", "90", "91", "91", "91", "--force"],
            ("--box contains no part of the surface", "world frame"),
        ),
        (["--rotate", "nan"], ("--rotate",)),
        (["--exposure", "2000"], ("--exposure is 2000", "64 stops")),
    ],
)
def test_invalid_options_are_refused_before_anything_is_written(found, capfd, options, words):
    refused(capfd, found, *options, words=words)


@pytest.mark.parametrize(("value", "word"), [(np.nan, "NaN"), (-3.0, "negative")])
def test_an_invalid_map_is_refused(found, tmp_path, capfd, value, word):
    radiance = np.ones((8, 16, 3), np.float32)
    radiance[2, 3] = value
    write_exr(tmp_path / "bad.exr", {"RGB": radiance})
    refused(capfd, found, "--env", tmp_path / "bad.exr", words=("bad.exr", word))


def test_a_free_light_needs_a_map(given, capfd):
    refused(capfd, given, words=("not an environment map", "--env"))


def test_a_folder_that_cannot_be_written(found, sky, tmp_path, capfd):
    (tmp_path / "file").write_text("")
    refused(capfd, found, "--env", sky, "--out", tmp_path / "file" / "relit", words=("cannot be written",))
    refused(capfd, found, "--env", sky, "--out", tmp_path / "file", words=("is a file",))


def test_a_full_disk_leaves_no_incomplete_image(given, sky, tmp_path, capfd):
    """The size of files is limited below that of an image: there is one line, and no file that seems
    finished.
    """
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1500, before[1]))
    try:
        refused(capfd, given, "--env", sky, "--out", tmp_path / "out", words=("000.exr", "cannot be written"))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not [path for path in (tmp_path / "out").rglob("*") if path.is_file()]


def test_without_a_denoiser_there_is_an_error(found, sky, capfd, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "pyoidn", None)
    refused(
        capfd, found, "--env", sky, "--denoise", words=("pyoidn", "pip install 'neilfpp-method[denoise]'")
    )


def test_true_images_for_each_map(found, sky, capfd):
    refused(capfd, found, "--env", sky, "--truth", "a", "b", words=("2 folders",))


def test_the_commands_of_the_docs_parse(monkeypatch):
    """Every command line of docs/relighting.md is one that the parser takes."""
    text = (Path(__file__).parents[2] / "docs" / "relighting.md").read_text()
    lines = [line.strip() for line in text.splitlines() if line.startswith("    neilfpp relight")]
    assert len(lines) >= 5
    for line in lines:
        taken = []
        monkeypatch.setitem(COMMANDS, "relight", Command(COMMANDS["relight"].options, taken.append, []))
        assert main(line.split()[1:]) == 0, line
        assert taken[0].run == Path("RUN")
