"""Run folders and output paths that are refused."""

from __future__ import annotations

import json
import shutil

import pytest

from neilfpp_method.cli import main
from neilfpp_method.train.checkpoint import checkpoint_path, last_checkpoint
from tests.calls import refused


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
    damaged, missing = last_checkpoint(run), checkpoint_path(run, "joint")
    damaged.write_bytes(b"weights")
    missing.unlink()
    for path, complaint in ((damaged, "not a readable checkpoint"), (missing, "no checkpoint")):
        command = [name, run, "--device", "cpu", "--checkpoint", path.stem]
        refused(capfd, command, path, complaint, leaves=tmp_path)


@pytest.mark.parametrize("name", ["train", "eval", "render", "export"])
def test_a_run_whose_capture_has_moved(tmp_path, capfd, trained, name):
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    last_checkpoint(run).write_bytes(checkpoint_path(run, "sdf_init").read_bytes())
    source = json.loads((run / "capture.json").read_text())
    (run / "capture.json").write_text(json.dumps({**source, "root": str(tmp_path / "away")}))
    command = [name, "--out", run, "--resume"] if name == "train" else [name, run]
    complaint = ("the run's capture is not there", run / "capture.json")
    refused(capfd, [*command, "--device", "cpu"], tmp_path / "away", *complaint, leaves=tmp_path)
    if name == "export":  # what the remedy says mends it
        (run / "capture.json").write_text(json.dumps(source))
        assert main(["export", str(run), "--device", "cpu", "--resolution", "16"]) == 0


@pytest.mark.parametrize("name", ["eval", "render", "export", "relight"])
def test_a_run_whose_scene_frame_has_been_edited(tmp_path, capfd, trained, name):
    """The fields of a run have a meaning only in the frame in which they were trained."""
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    source = json.loads((run / "capture.json").read_text())
    for change in ({"unit": 1.01 * source["unit"]}, {"center": [0.0, 0.0, 0.0]}):
        (run / "capture.json").write_text(json.dumps({**source, **change}))
        words = (run, "the training cameras are not where they were", "restore unit and center")
        refused(capfd, [name, run, "--device", "cpu"], *words, leaves=tmp_path)


def test_a_training_whose_scene_frame_has_been_edited(tmp_path, capfd, trained):
    run = tmp_path / "run"
    shutil.copytree(trained, run)
    before = checkpoint_path(run, "sdf_init").read_bytes()
    last_checkpoint(run).write_bytes(before)
    source = json.loads((run / "capture.json").read_text())
    (run / "capture.json").write_text(json.dumps({**source, "unit": 2 * source["unit"]}))
    assert main(["train", "--out", str(run), "--resume", "--device", "cpu"]) == 2
    said = capfd.readouterr().err
    assert said.count("error: ") == 1
    assert "the training cameras are not where they were" in said
    assert last_checkpoint(run).read_bytes() == before


def test_a_run_whose_capture_has_other_cameras(tmp_path, capfd, trained, capture):
    """Views may be added and removed, but those of the training must stay where they were."""
    run, moved = tmp_path / "run", tmp_path / "moved"
    shutil.copytree(trained, run)
    shutil.copytree(capture, moved)
    source = json.loads((run / "capture.json").read_text())
    (run / "capture.json").write_text(json.dumps({**source, "root": str(moved)}))
    scene = moved / "inputs" / "sfm_scene.json"
    described = json.loads(scene.read_text())
    cameras, files = described["camera_track_map"]["images"], described["image_path"]["file_paths"]
    cameras.pop("1"), files.pop("1")
    (moved / "inputs" / "images" / "001.exr").unlink()
    scene.write_text(json.dumps(described))
    command = ["export", run, "--resolution", "16", "--device", "cpu", "--out", tmp_path / "out"]
    assert main([str(word) for word in command]) == 0
    for camera in cameras.values():
        camera["camera"]["extrinsic"][3] += 0.1
    scene.write_text(json.dumps(described))
    refused(capfd, command, run, "the training cameras are not where they were", leaves=tmp_path)


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


@pytest.mark.parametrize(
    ("command", "name", "complaint"),
    [
        (
            "report",
            "config.json",
            "describes a run or a capture, and would be replaced; choose another --out",
        ),
        ("eval", "config.json", "describes a run or a capture, and would be replaced; choose another --out"),
        ("report", "report.pdf", "a report is an HTML page; give --out a name that ends in .html"),
    ],
)
def test_a_result_replaces_no_file_of_another_kind(tmp_path, capfd, trained, command, name, complaint):
    out = tmp_path / name
    out.write_text("{}")
    refused(capfd, [command, trained, "--out", out, "--device", "cpu"], out, complaint, leaves=tmp_path)


def test_a_file_and_a_run_where_a_capture_is_wanted_and_the_reverse(tmp_path, capfd, capture, trained):
    file = tmp_path / "file"
    file.write_text("")
    for data, complaint in ((file, "a file, not a folder"), (trained, "a run folder, not a capture")):
        refused(capfd, ["train", "--data", data, "--out", tmp_path / "run"], data, complaint, leaves=tmp_path)
        refused(capfd, ["inspect", data], data, complaint, leaves=tmp_path)
        command = ["prepare", data, "--out", tmp_path / "prepared"]
        refused(capfd, command, data, complaint.split(",")[0], leaves=tmp_path)
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
