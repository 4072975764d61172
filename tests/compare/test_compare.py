"""Comparison of small runs: the table, its marks, and the image."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from neilfpp_method.cli import main
from neilfpp_method.compare.runs import labels_of
from neilfpp_method.compare.sheet import shortened
from neilfpp_method.compare.write import compare_runs
from neilfpp_method.data.files.images import image_header, read_image
from neilfpp_method.errors import UserError
from neilfpp_method.train.checkpoint import last_checkpoint
from tests.calls import train_tiny
from tests.data.make_capture import make_capture

CELL, GAP, LEFT, TOP = 240, 8, 290, 206
"""Layout of a sheet: width of an image, distance between two images, and position of the first one, in
pixels.
"""

STEPS = [f"--config.train.{stage}-steps=2" for stage in ("sdf", "material", "joint")]


def train(capture: Path, out: Path, *options: str) -> Path:
    return train_tiny(capture, out, "--no-report", *STEPS, *options)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_capture(tmp_path_factory.mktemp("captures") / "ball", size=(40, 30), masks=True, test=(0, 3))


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory, capture: Path) -> Path:
    """A run with a given mesh."""
    out = tmp_path_factory.mktemp("runs") / "mesh"
    return train(capture, out, "--host", "mesh", "--config.train.joint-steps=0")


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory, capture: Path, given: Path) -> dict[str, Path]:
    """Runs of one capture: recovered geometry with figures, a given mesh, and one without test views."""
    root = tmp_path_factory.mktemp("runs")
    everything = Path(shutil.copytree(given, root / "all"))
    point_at(everything, test_every=0)
    return {"found": measured(train(capture, root / "found")), "mesh": given, "all": everything}


def measured(run: Path) -> Path:
    """The run with figures as `neilfpp eval` writes them."""
    figures = {"pbr_psnr": 20.0, "volume_psnr": 21.0, "base_color_psnr": 12.5}
    what = {"view_names": ["000", "003"], "width": 40, "height": 30, "step": 6}
    (run / "metrics.json").write_text(json.dumps(figures | {"health": "sound"}))
    described = {"mask_source": "true depth", "measured": what}
    (run / "metrics-protocol.json").write_text(json.dumps(described))
    return run


def point_at(run: Path, **changes: object) -> Path:
    """The run with changed options of reading its capture."""
    source = run / "capture.json"
    source.write_text(json.dumps(json.loads(source.read_text()) | changes))
    return run


@pytest.fixture
def runs(trained: dict[str, Path], tmp_path: Path) -> dict[str, Path]:
    """Copies that a test may change."""
    return {name: Path(shutil.copytree(path, tmp_path / "runs" / name)) for name, path in trained.items()}


def compare(out: Path, *arguments: object) -> dict:
    assert main(["compare", *map(str, arguments), "--out", str(out), "--device", "cpu"]) == 0
    return json.loads((out / "compare.json").read_text())


def part(table: dict, kind: str, name: str = "") -> dict:
    return next(p for p in table["parts"] if (p["kind"], p["name"]) == (kind, name))


# ------------------------------------------------------------------------------------------------- good input


def test_runs_of_two_hosts_are_compared(runs, tmp_path, capsys):
    table = compare(tmp_path / "out", runs["found"], runs["mesh"], "--views", "2", "--size", "40")
    assert table["runs"] == ["found", "mesh"]
    assert table["views"] == ["000", "003"]
    settings = {key: row["values"] for key, row in part(table, "settings")["rows"].items()}
    assert settings["train.joint_steps"] == {"found": "2", "mesh": "0"}
    assert settings["host.kind"] == {"found": "volsdf", "mesh": "mesh"}
    assert "train.seed" not in settings  # the same in both
    assert "capture.root" not in settings
    shown = part(table, "figures", "shown")["rows"]
    assert all(isinstance(v, float) for v in shown["base_color_psnr_scaled"]["values"].values())
    # Work adds up to the stages.
    seconds = {key: row["values"]["mesh"] for key, row in part(table, "seconds")["rows"].items()}
    work = sum(value or 0 for key, value in seconds.items() if key.startswith("work."))
    assert work == pytest.approx(seconds["together"])
    own = part(table, "figures", "neilfpp")
    assert own["rows"]["pbr_psnr"]["values"]["mesh"] is None
    assert f"neilfpp eval {runs['mesh']} --width 40" in own["notes"][0]
    told = capsys.readouterr().out
    for words in (
        "Settings that differ",
        "Protocol neilfpp, 2 views of 40×30 pixels",
        "mesh was not measured",
    ):
        assert words in told


def test_the_sheet_has_the_truth_and_the_maps_of_each_run(runs, tmp_path, capture):
    compare(tmp_path, runs["found"], runs["mesh"], "--views", "2", "--size", "40")
    sheet = (read_image(tmp_path / "compare.png").pixels * 255).round().astype(np.uint8)
    # Two sections of seven maps, three columns of cells 240 wide: 30/40 of that is 180 high.
    section = 70 + 7 * (180 + GAP) + 28
    assert sheet.shape == (2 * 40 - 28 + 96 + 2 * section, LEFT + 3 * CELL + 2 * GAP + 40, 3)
    row = 180 + GAP
    truth, found, mesh = (
        sheet[TOP + 2 * row :, LEFT + k * (CELL + GAP) :][:180, :CELL].astype(int) for k in range(3)
    )
    colors = read_image(capture / "ground_truths" / "materials" / "kd" / "000.png").pixels
    middle = colors[15, 20]
    encoded = np.where(middle < 0.0031308, 12.92 * middle, 1.055 * middle ** (1 / 2.4) - 0.055) * 255
    np.testing.assert_allclose(truth[93, 123], encoded, atol=4)
    assert np.abs(found - truth).mean() > 1
    assert np.abs(found - mesh).mean() > 1


def test_the_csv_is_the_same_table(runs, tmp_path):
    table = compare(tmp_path, runs["found"], runs["mesh"], "--size", "40")
    lines = list(csv.reader((tmp_path / "compare.csv").open()))
    assert lines[0] == ["kind", "name", "key", "found", "mesh"]
    values = {tuple(line[:3]): line[3:] for line in lines[1:]}
    for section in table["parts"]:
        for key, row in section["rows"].items():
            expected = ["" if v is None else str(v) for v in row["values"].values()]
            assert values[section["kind"], section["name"], key] == expected
    assert values["figures", "neilfpp", "comparable"] == ["yes", "yes"]


def test_without_views_nothing_is_rendered(runs, tmp_path):
    (tmp_path / "compare.png").write_bytes(b"of an earlier comparison")
    table = compare(tmp_path, runs["found"], runs["mesh"], "--views", "0")
    assert sorted(path.name for path in tmp_path.glob("compare*")) == ["compare.csv", "compare.json"]
    assert not [p for p in table["parts"] if p["name"] == "shown"]


# --------------------------------------------------------------------------------- what is not to be compared


def test_figures_of_another_size_are_marked(runs, tmp_path, capsys):
    assert main(["eval", str(runs["mesh"]), "--device", "cpu", "--width", "20"]) == 0
    table = compare(tmp_path / "out", runs["found"], runs["mesh"], "--views", "0")
    own = part(table, "figures", "neilfpp")
    assert own["apart"] == ["mesh"]
    assert "mesh was measured on 2 views of 20×15 pixels, found on 2 views of 40×30 pixels" in own["notes"][0]
    assert f"neilfpp eval {runs['mesh']} --width 40" in own["notes"][0]
    assert "dB *" in capsys.readouterr().out
    # What the note says makes them equal.
    assert main(["eval", str(runs["mesh"]), "--device", "cpu", "--width", "40"]) == 0
    table = compare(tmp_path / "out", runs["found"], runs["mesh"], "--views", "0")
    assert part(table, "figures", "neilfpp")["apart"] == []


def test_figures_of_other_views_pixels_and_versions_are_marked(runs, tmp_path):
    described = runs["found"] / "metrics-protocol.json"
    for name in ("metrics.json", "metrics-protocol.json"):
        shutil.copy(runs["found"] / name, runs["mesh"] / name)
    stored = json.loads(described.read_text())

    def note(values: dict) -> str:
        described.write_text(json.dumps(values))
        own = part(
            compare(tmp_path / "out", runs["mesh"], runs["found"], "--views", "0"), "figures", "neilfpp"
        )
        assert own["apart"] == ["found"]
        return own["notes"][0]

    other_views = {**stored, "measured": {**stored["measured"], "view_names": ["000", "004"]}}
    assert "measured on other views" in note(other_views)
    assert "same masks" in note({**stored, "mask_source": "rendered opacity"})
    assert "measured by an earlier version" in note({"mask_source": "true depth"})


def test_runs_of_two_captures_have_a_table_and_no_picture(runs, tmp_path):
    other = make_capture(tmp_path / "other", size=(40, 30), views=7, masks=True)
    stranger = Path(shutil.copytree(runs["mesh"], tmp_path / "runs" / "stranger"))
    table = compare(tmp_path / "out", runs["found"], point_at(stranger, root=str(other)))
    assert table["views"] == []
    assert "stranger was trained on another capture" in table["notes"][0]
    assert part(table, "figures", "neilfpp")["apart"] == ["stranger"]
    assert not (tmp_path / "out" / "compare.png").exists()


def test_different_photographs_from_the_same_cameras_are_noted(runs, tmp_path):
    copied = make_capture(tmp_path / "copied", size=(40, 30), masks=True, test=(0, 3))
    bright = make_capture(tmp_path / "bright", size=(40, 30), masks=True, test=(0, 3), background=0.5)
    for root, told in ((copied, 0), (bright, 1)):
        other = Path(shutil.copytree(runs["mesh"], tmp_path / "runs" / root.name))
        point_at(other, root=str(root))
        table = compare(tmp_path / "out", runs["found"], other, "--views", "1", "--size", "40")
        assert sum("different photographs" in note for note in table["notes"]) == told
        assert table["views"] == ["000"]


# ----------------------------------------------------------------------------------------------- unusual runs


def test_a_run_without_test_views_shows_training_views(runs, tmp_path):
    table = compare(tmp_path, runs["all"], runs["found"], "--views", "2", "--size", "40")
    assert table["views"] == ["000", "005"]
    assert "all, found used the views shown here" in table["notes"][0]
    assert part(table, "figures", "shown")["title"].endswith("used in training")
    assert image_header(tmp_path / "compare.png").width == LEFT + 3 * CELL + 2 * GAP + 40


def test_runs_without_truth_have_only_figures_of_images(given, tmp_path):
    root = make_capture(tmp_path / "photos", size=(40, 30), test=(0,))
    for folder in ("inputs/depth_maps", "inputs/normal_maps", "ground_truths"):
        shutil.rmtree(root / folder)
    runs = [point_at(Path(shutil.copytree(given, tmp_path / name)), root=str(root)) for name in ("a", "b")]
    table = compare(tmp_path / "out", *runs, "--views", "1", "--size", "24")
    shown = part(table, "figures", "shown")
    assert {"pbr_psnr", "volume_psnr"} <= shown["rows"].keys()
    assert not [key for key in shown["rows"] if key.startswith(("base_color", "normal", "rough"))]
    a, b = shown["rows"]["pbr_psnr"]["values"].values()
    assert a == b  # one training, copied
    assert part(table, "settings")["rows"] == {}


def test_a_run_before_its_first_checkpoint_is_only_in_the_table(runs, tmp_path):
    shutil.rmtree(last_checkpoint(runs["mesh"]).parent)
    table = compare(tmp_path, runs["found"], runs["mesh"], "--views", "1", "--size", "40")
    notes = part(table, "runs")["notes"]
    assert any(
        "stopped before its first checkpoint" in note and f"--out {runs['mesh']} --resume" in note
        for note in notes
    )
    assert part(table, "figures", "shown")["rows"]["pbr_psnr"]["values"]["mesh"] is None
    assert image_header(tmp_path / "compare.png").width == LEFT + 2 * CELL + GAP + 40


# -------------------------------------------------------------------------------------------------- bad input


def test_invalid_runs_are_refused_in_one_line(runs, tmp_path, capsys):
    lone, out = tmp_path / "empty", tmp_path / "out"
    lone.mkdir()
    for arguments, told in (
        ([runs["found"], lone], f"{lone}: no run here"),
        ([runs["found"], tmp_path / "nowhere"], "nowhere: no run here"),
        ([runs["found"]], "runs to compare: 1"),
        ([runs["found"], runs["found"] / ".." / "found"], "given twice"),
        ([runs["found"], runs["mesh"], "--views", "99"], "--views"),
        ([runs["found"], runs["mesh"], "--size", "3"], "--size"),
    ):
        capsys.readouterr()
        assert main(["compare", *map(str, arguments), "--out", str(out), "--device", "cpu"]) == 2
        error = capsys.readouterr().err
        assert told in error
        assert error.count("\n") == 1
        assert not out.exists()


def test_a_capture_that_has_moved_is_named(runs, tmp_path):
    point_at(runs["mesh"], root=str(tmp_path / "gone"))
    with pytest.raises(UserError, match="gone: the run's capture is not there"):
        compare_runs([runs["found"], runs["mesh"]], tmp_path / "out", 1, 40, "cpu")
    assert not (tmp_path / "out").exists()


# ------------------------------------------------------------------------------------------------------ parts


def test_labels_are_unique():
    assert labels_of([Path("/a/x"), Path("/a/y")]) == ["x", "y"]
    assert labels_of([Path("/a/x"), Path("/b/x"), Path("/b/y")]) == ["a/x", "b/x", "b/y"]


def test_long_labels_keep_both_ends():
    assert shortened("short") == "short"
    long = shortened("a-run-with-a-very-long-name-of-the-third-of-may")
    assert len(long) == 27
    assert long.startswith("a-run")
    assert long.endswith("third-of-may")
