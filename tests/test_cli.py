"""The command line from end to end: what it says, where it stops, and what it leaves behind."""

from __future__ import annotations

import io
import json
import math
import shutil
import subprocess
import sys
from collections.abc import Callable
from contextlib import redirect_stdout
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pytest
import trimesh

from neilfpp_method.cli import COMMANDS, main
from neilfpp_method.commands.evaluate import Eval
from neilfpp_method.data.images import read_image, write_exr, write_png
from neilfpp_method.evaluate import scene_metrics
from neilfpp_method.evaluate.published import PROTOCOLS
from neilfpp_method.settings.presets import PRESETS
from tests.data.make_capture import CENTRE, RADIUS, make_capture
from tests.train.small_runs import small_config


@pytest.fixture(autouse=True)
def _tiny_preset(monkeypatch):
    monkeypatch.setitem(PRESETS, "tiny", small_config)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_capture(tmp_path_factory.mktemp("capture") / "sphere", masks=True)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory, capture: Path) -> Path:
    out = tmp_path_factory.mktemp("runs") / "sphere"
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(PRESETS, "tiny", small_config)
        assert train("--data", capture, "--out", out) == 0
    return out


@pytest.fixture(scope="module")
def completion() -> str:
    """What `neilfpp completion bash` prints."""
    printed = io.StringIO()
    with redirect_stdout(printed):
        assert main(["completion", "bash"]) == 0
    return printed.getvalue()


def train(*options: object) -> int:
    return main(["train", "--preset", "tiny", "--device", "cpu", *map(str, options)])


def tree(folder: Path) -> dict[Path, bytes | None]:
    """Everything in a folder."""
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


# ----------------------------------------------------------------------------------------------- the good way


def test_train_says_what_it_does_and_leaves_a_run(trained):
    for name in ("config.json", "capture.json", "scene.json", "environment.json", "timing.json"):
        assert json.loads((trained / name).read_text())
    stages = ("sdf_init", "material_init", "joint")
    assert {path.name for path in (trained / "checkpoints").iterdir()} == {
        f"{s}.pt" for s in ("last", *stages)
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
    assert np.linalg.norm(mesh.centroid - CENTRE) < 0.25 * RADIUS
    assert mesh.visual.vertex_colors.shape == (len(mesh.vertices), 4)


def test_a_run_without_a_name_is_named_after_its_capture(capture, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    steps = [f"--config.train.{stage}-steps=1" for stage in ("sdf", "material", "joint")]
    assert main(["train", "--data", str(capture), "--device", "cpu", "--preset=tiny", *steps]) == 0
    assert (tmp_path / "runs" / "sphere-fast" / "config.json").is_file()


# ------------------------------------------------------------------------------------------------------- help


@pytest.mark.parametrize("arguments", [[], ["--help"], ["-h"]])
def test_help_names_the_commands(arguments, capsys):
    assert main(arguments) == 0
    said = capsys.readouterr().out
    for name, command in COMMANDS.items():
        assert f"  {name} " in said
        assert command.summary in said
    assert "examples:" in said


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_a_command_shows_examples(name, capsys):
    assert main([name, "--help"]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    assert "Examples:" in said.out
    for example in COMMANDS[name].examples:
        assert example.split("  ")[0] in said.out
        assert example.startswith(f"neilfpp {name}")


def test_the_examples_parse(monkeypatch):
    """Each example of the help is a command that the parser takes."""
    for name, command in COMMANDS.items():
        for example in command.examples:
            seen = []
            monkeypatch.setitem(
                COMMANDS, name, command.__class__(command.options, seen.append, command.examples)
            )
            assert main(example.split("  ")[0].split()[1:]) == 0
            assert isinstance(seen[0], command.options)


def test_help_of_train_fits_on_two_screens_and_all_of_it_is_one_option_away(capsys):
    assert main(["train", "--help"]) == 0
    usual = capsys.readouterr().out
    assert len(usual.splitlines()) <= 68
    assert "--help-all" in usual
    assert "--config FILE" in usual
    assert "--config.train.rays" not in usual
    assert main(["train", "--help-all"]) == 0
    assert "--config.train.rays" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments", [["--help"], ["train", "--help"], ["train", "--data", "x", "--colour", "red"]]
)
def test_help_and_mistyped_options_do_not_wait_for_torch(arguments):
    asks = f"import sys; from neilfpp_method.cli import main; main({arguments})"
    asks += "; sys.exit('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", asks], capture_output=True, timeout=60, check=False)
    assert done.returncode == 0


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
@pytest.mark.parametrize(
    ("words", "completed"),
    [
        ("trai", "train"),
        ("train --da", "--data"),
        ("eval --check", "--checkpoint"),
        ("train --config.train.ra", "--config.train.rays"),
    ],
)
def test_bash_completes(completion, words, completed):
    """As bash asks: its variables are set, the registered function is called, and `COMPREPLY` is the
    answer.
    """
    before = ["neilfpp", *words.split()]
    ask = f"COMP_WORDS=({' '.join(before)}); COMP_CWORD={len(before) - 1}; COMP_LINE='neilfpp {words}'"
    call = "eval \"$(complete -p neilfpp | sed 's/.*-F \\([^ ]*\\).*/\\1/')\" neilfpp; echo ${COMPREPLY[@]}"
    script = f"{completion}\n{ask}; COMP_POINT=${{#COMP_LINE}}\n{call}"
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.split() == [completed]


def test_version(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("neilfpp 0.")


# -------------------------------------------------------------------------------------------------- bad input


def refused(capfd, arguments: list[object], *words: object, leaves: Path) -> None:
    """The command ends with 2 and one line that has these words and a remedy, and changes nothing in a
    folder.
    """
    before = tree(leaves)
    capfd.readouterr()
    assert main([str(argument) for argument in arguments]) == 2
    said = capfd.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith("error: ")
    assert len(said.split("; ")) >= 2
    assert said.split("; ")[-1].strip()
    for word in words:
        assert str(word) in said
    assert tree(leaves) == before


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["paint"], ("unknown command 'paint'", "train", "eval")),
        (["tran", "--data", "x"], ("unknown command 'tran'", "did you mean neilfpp train?")),
        (["train", "--dta", "x"], ("--dta", "did you mean --data?", "neilfpp train --help")),
        (
            ["train", "--data", "x", "--config.shading.specular", "False"],
            ("did you mean --config.shading.no-specular?",),
        ),
        (
            ["train", "--data", "x", "--config.shading.specular", "true"],
            ("did you mean --config.shading.specular?",),
        ),
        (["train", "--preset", "slow"], ("unknown preset 'slow'", "fast", "paper-ngp")),
        (["train", "--preset=slow"], ("unknown preset 'slow'",)),
        (["train", "--preset"], ("--preset", "neilfpp train --help")),
        (["train", "--data", "x", "--colour", "red"], ("--colour", "neilfpp train --help")),
        (["train", "--data", "x", "--config.train.rayss", "3"], ("did you mean --config.train.rays?",)),
        (["train", "--data", "x", "--config.train.rays", "few"], ("--config.train.rays", "'few'")),
        (["train", "--response", "hdr"], ("--response", "linear", "srgb")),
        (["train", "--test-every", "often"], ("--test-every", "'often'")),
        (["train"], ("--data",)),
        (["train", "--resume"], ("--resume needs the run's folder", "--out")),
        (["train", "teapot"], ("teapot", "did you mean --data teapot?", "neilfpp train --help")),
        (["eval"], ("missing: PATH (The run folder); see neilfpp eval --help",)),
        (
            ["prepare"],
            (
                "missing: PATH (Folder of photographs, with its sub-folders), ",
                ", --out PATH (Folder of the capture); ",
            ),
        ),
        (["eval", "a", "b"], ("b", "neilfpp eval --help")),
        (["export", "a", "--checkpoint", "first"], ("--checkpoint", "sdf_init")),
        (["render", "a", "--views", "best"], ("--views", "test")),
    ],
)
def test_a_command_line_that_makes_no_sense(tmp_path, monkeypatch, capfd, arguments, words):
    monkeypatch.chdir(tmp_path)
    refused(capfd, arguments, *words, leaves=tmp_path)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--config.train.rays", "0"], ("--config.train.rays is 0",)),
        (["--config.train.checkpoint-every", "0"], ("--config.train.checkpoint-every is 0",)),
        (["--config.train.joint-steps", "-1"], ("no steps",)),
        (["--config.loss.volume", "0"], ("--config.loss.volume",)),
        (["--devices", "0"], ("--devices",)),
        (["--device", "cuda:99"], ("no device 'cuda:99' here", "cpu")),
        (["--device", "abacus"], ("no device 'abacus' here", "cpu")),
        (["--device", "meta"], ("no device 'meta' here", "cpu")),
        (["--test-every", "1"], ("all 6 views are held out",)),
        (["--format", "tape"], ("unknown capture format 'tape'", "sfm_scene", "colmap")),
        (["--format", "colmap"], ("not a capture of the format colmap", "sparse/0")),
    ],
)
def test_settings_that_cannot_be(tmp_path, monkeypatch, capture, capfd, options, words):
    monkeypatch.chdir(tmp_path)
    command = ["train", "--data", capture, "--preset", "tiny", "--device", "cpu", *options]
    refused(capfd, command, *words, leaves=tmp_path)


def edit_scene(change: Callable[[dict, dict], object]) -> Callable[[Path], None]:
    """Change the cameras and the file names of a scene file."""

    def apply(root: Path) -> None:
        path = root / "inputs" / "sfm_scene.json"
        scene = json.loads(path.read_text())
        change(scene["camera_track_map"]["images"], scene["image_path"]["file_paths"])
        path.write_text(json.dumps(scene))

    return apply


def paint(value: float) -> Callable[[Path], None]:
    """Put one pixel of a value into an image."""

    def apply(root: Path) -> None:
        path = root / "inputs" / "images" / "002.exr"
        pixels = read_image(path).pixels.copy()
        pixels[3, 4, 1] = value
        write_exr(path, {"RGB": pixels})

    return apply


def truncate(name: str) -> Callable[[Path], None]:
    def apply(root: Path) -> None:
        path = root / "inputs" / name
        path.write_bytes(path.read_bytes()[:-40])

    return apply


BROKEN = {
    "missing folder": (shutil.rmtree, "no such folder"),
    "not a capture": (lambda root: (root / "inputs" / "sfm_scene.json").unlink(), "inputs/sfm_scene.json"),
    "no images": (
        edit_scene(lambda cameras, files: (cameras.clear(), files.clear())),
        "sfm_scene.json: no images",
    ),
    "image without camera": (
        edit_scene(lambda cameras, _: cameras.pop("3")),
        "paths.3: an image without a camera",
    ),
    "camera without image": (
        edit_scene(lambda _, files: files.pop("3")),
        "images.3: a camera without an image",
    ),
    "image is not there": (lambda root: (root / "inputs" / "images" / "003.exr").unlink(), "003.exr"),
    "another size": (
        edit_scene(lambda cameras, _: cameras["3"].update(size=[48, 36])),
        "003.exr: 24×18 pixels",
    ),
    "NaN": (paint(np.nan), "002.exr: 1 pixels are NaN"),
    "infinite": (paint(np.inf), "002.exr: 1 pixels are NaN, infinite"),
    "negative": (paint(-0.25), "002.exr: 1 pixels are NaN, infinite or negative"),
    "unreadable image": (truncate("images/004.exr"), "004.exr: cannot be read"),
    "unreadable scene": (truncate("sfm_scene.json"), "sfm_scene.json: not valid JSON"),
    "empty mask": (
        lambda root: write_png(root / "inputs" / "masks" / "001.png", np.zeros((18, 24), np.uint8)),
        "masks/001.png: the mask shows no object",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_capture_that_cannot_be_used(tmp_path, capfd, capture, case):
    spoil, complaint = BROKEN[case]
    root = tmp_path / "spoilt"
    shutil.copytree(capture, root)
    spoil(root)
    command = [
        "train",
        "--data",
        root,
        "--out",
        tmp_path / "runs" / "new",
        "--preset",
        "tiny",
        "--device",
        "cpu",
    ]
    refused(capfd, command, root, complaint, leaves=tmp_path)


@pytest.mark.parametrize("folder", ["", "front", "inputs"])
def test_a_folder_of_photographs_has_to_be_prepared(tmp_path, capfd, folder):
    """Nothing but pictures: no cameras are known yet, and `neilfpp prepare` finds them."""
    photos = tmp_path / "photos"
    (photos / folder).mkdir(parents=True)
    for name in ("001.jpg", "002.JPG", "003.dng", ".004.jpg", "notes.txt"):
        (photos / folder / name).write_bytes(b"")
    words = (f"{photos}: 3 photographs and no cameras", f"run neilfpp prepare {photos} --out CAPTURE")
    refused(capfd, ["train", "--data", photos], *words, leaves=tmp_path)


def test_a_point_cloud_that_cannot_be_read(tmp_path, capfd, capture):
    root = tmp_path / "broken"
    shutil.copytree(capture, root)
    (root / "inputs" / "model" / "oriented_pcd.ply").write_bytes(b"ply")
    command = ["train", "--data", root, "--out", tmp_path / "run", "--preset", "tiny", "--device", "cpu"]
    refused(capfd, [*command, "--config.loss.point-cloud", "0.1"], root, "oriented_pcd.ply", leaves=tmp_path)


def test_a_folder_that_is_taken(tmp_path, capfd, capture):
    out = tmp_path / "photos"
    out.mkdir()
    (out / "cat.png").write_bytes(b"meow")
    command = ["train", "--data", capture, "--out", out, "--preset", "tiny", "--device", "cpu"]
    refused(capfd, command, out, "exists already", "--out", "--resume", leaves=tmp_path)


@pytest.mark.parametrize("name", ["train", "eval", "render", "export"])
def test_a_run_of_another_version(tmp_path, capfd, trained, name):
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    settings = json.loads((run / "config.json").read_text())
    (run / "config.json").write_text(json.dumps({**settings, "format": 99}))
    command = [name, "--out", run, "--resume"] if name == "train" else [name, run, "--out", tmp_path / "out"]
    refused(capfd, [*command, "--device", "cpu"], run / "config.json", "format 99", leaves=tmp_path)


@pytest.mark.parametrize("name", ["eval", "render", "export"])
def test_a_folder_that_is_no_run(tmp_path, capfd, trained, name):
    refused(capfd, [name, tmp_path, "--device", "cpu"], tmp_path, "no run here", leaves=tmp_path)
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    for file, complaint in (("last.pt", "not a readable checkpoint"), ("joint.pt", "no checkpoint")):
        path = run / "checkpoints" / file
        path.write_bytes(b"weights") if file == "last.pt" else path.unlink()
        command = [name, run, "--device", "cpu", "--checkpoint", path.stem]
        refused(capfd, command, path, complaint, leaves=tmp_path)


@pytest.mark.parametrize("name", ["train", "eval", "render", "export"])
def test_a_run_whose_capture_has_moved(tmp_path, capfd, trained, name):
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    (run / "checkpoints" / "last.pt").write_bytes((run / "checkpoints" / "sdf_init.pt").read_bytes())
    source = json.loads((run / "capture.json").read_text())
    (run / "capture.json").write_text(json.dumps({**source, "root": str(tmp_path / "away")}))
    command = [name, "--out", run, "--resume"] if name == "train" else [name, run]
    complaint = ("the run's capture is not there", run / "capture.json")
    refused(capfd, [*command, "--device", "cpu"], tmp_path / "away", *complaint, leaves=tmp_path)
    if name == "export":  # what the remedy says mends it
        (run / "capture.json").write_text(json.dumps(source))
        assert main(["export", str(run), "--device", "cpu", "--resolution", "16"]) == 0


@pytest.mark.parametrize("name", ["train", "eval", "render", "export"])
def test_a_place_that_cannot_be_written(tmp_path, capfd, capture, trained, name):
    """A file stands where a folder would have to."""
    (tmp_path / "file").write_text("")
    out = tmp_path / "file" / "out"
    options = ["--data", capture, "--preset", "tiny"] if name == "train" else [trained]
    complaint = f"cannot be written, because {tmp_path / 'file'} is not a writable folder"
    refused(capfd, [name, *options, "--out", out, "--device", "cpu"], out, complaint, leaves=tmp_path)


@pytest.mark.parametrize(
    ("command", "is_file"),
    [(["export", "--what", "asset"], True), (["render"], True), (["eval"], False), (["report"], False)],
)
def test_a_file_where_a_folder_is_wanted_and_the_reverse(tmp_path, capfd, trained, command, is_file):
    out = tmp_path / "out"
    out.write_text("") if is_file else out.mkdir()
    complaint = "is a file; name a folder" if is_file else "is a folder; name a file"
    name, *rest = command
    refused(capfd, [name, trained, "--out", out, "--device", "cpu", *rest], out, complaint, leaves=tmp_path)


def test_a_file_and_a_run_where_a_capture_is_wanted_and_the_reverse(tmp_path, capfd, capture, trained):
    file = tmp_path / "file"
    file.write_text("")
    for data, complaint in ((file, "a file, not a folder"), (trained, "a run folder, not a capture")):
        refused(capfd, ["train", "--data", data, "--out", tmp_path / "run"], data, complaint, leaves=tmp_path)
        refused(capfd, ["inspect", data], data, complaint, leaves=tmp_path)
    refused(capfd, ["train", "--data", capture, "--out", file], file, "is a file; name a", leaves=tmp_path)
    for name in ("eval", "render", "relight", "export", "report", "view"):
        refused(capfd, [name, file], file, "no run here (a file)", leaves=tmp_path)
        refused(capfd, [name, tmp_path / "x"], "x: no run here (no such folder)", leaves=tmp_path)


@pytest.mark.parametrize("resolution", [0, -3, 5000])
def test_a_surface_of_no_cells_or_too_many(tmp_path, capfd, trained, resolution):
    command = ["export", trained, "--out", tmp_path / "out", "--resolution", resolution, "--device", "cpu"]
    refused(capfd, command, f"{resolution} cells per side; give 8 to 2048", leaves=tmp_path)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["export", "--what", "mesh", "light"], ("no light yet at step 4",)),
        (["render", "--what", "light"], ("the run has no light yet at step 4",)),
        (["render", "--confidence"], ("no material at step 4",)),
    ],
)
def test_what_a_stage_does_not_have_yet(tmp_path, capfd, trained, options, words):
    """Nothing of what is asked for is written, not even what there is."""
    name, *rest = options
    command = [name, trained, "--checkpoint", "sdf_init", "--device", "cpu", "--out", tmp_path / "out", *rest]
    refused(capfd, command, *words, leaves=tmp_path)


def test_a_name_that_the_system_refuses(tmp_path, capfd):
    refused(capfd, ["eval", tmp_path / ("x" * 300)], "x" * 300, "File name too long", leaves=tmp_path)


def test_a_real_process_says_one_line_and_no_more(tmp_path):
    """No warning of a library before it, no traceback after it."""
    command = [sys.executable, "-m", "neilfpp_method.cli", "train", "--data", str(tmp_path / "nowhere")]
    process = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert process.returncode == 2
    assert process.stdout == ""
    assert process.stderr == f"error: {tmp_path / 'nowhere'}: no such folder; give the folder of a capture\n"
