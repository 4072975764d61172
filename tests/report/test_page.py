"""The page of small runs: it loads nothing, escapes text from files, and reports missing parts."""

from __future__ import annotations

import base64
import hashlib
import json
import os
import re
import shutil
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from neilfpp_method.cli import main
from neilfpp_method.errors import UserError
from neilfpp_method.evaluate.glossary import style_of
from neilfpp_method.export.asset.simplify import distance_between
from neilfpp_method.export.asset.surface import creased
from neilfpp_method.report import surface as report_surface
from neilfpp_method.report.files import changed_settings, read_files
from neilfpp_method.report.markup import Html, data_block, element
from neilfpp_method.report.write import ReportOptions, write_report
from neilfpp_method.settings.plain import changed
from neilfpp_method.settings.presets import fixed_geometry, preset
from neilfpp_method.train.checkpoint import checkpoint_path, last_checkpoint
from neilfpp_method.train.run import load_run
from tests.calls import train_tiny
from tests.data.make_capture import make_capture
from tests.export.asset.tables import modelled

HOSTILE = '"><script>alert(1)<&script>'
SMALL = ReportOptions(views=1, size=24)


class Page(HTMLParser):
    """The text of a page, its data blocks, and everything that it would load from elsewhere."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.html, self.text, self.loaded, self.scripts, self.unnamed = html, "", [], 0, 0
        self.data: dict[str, dict] = {}
        self._block: str | None = None
        self.feed(html)

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        given = dict(attributes)
        self.loaded += [
            v for n, v in attributes if n in ("src", "href") and v and not v.startswith(("data:", "#"))
        ]
        self.unnamed += tag == "img" and not given.get("alt")
        self._block = given.get("id") if tag == "script" else None
        self.scripts += tag == "script" and self._block is None

    @property
    def captions(self) -> list[str]:
        """The captions of the figures."""
        return [unescape(text) for text in re.findall(r"<figcaption>(.*?)</figcaption>", self.html)]

    def handle_data(self, data: str) -> None:
        if self._block:
            self.data[self._block] = json.loads(data)
        else:
            self.text += data


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A run of a capture with a hostile name; `train` has written its page."""
    root = make_capture(tmp_path_factory.mktemp("captures") / HOSTILE, masks=True)
    return train_tiny(root, tmp_path_factory.mktemp("runs") / "run")


@pytest.fixture
def run(trained: Path, tmp_path: Path) -> Path:
    """A copy that a test may change."""
    return Path(shutil.copytree(trained, tmp_path / "run"))


def page_of(run: Path) -> Page:
    return Page(write_report(run, run / "report.html", SMALL).read_text("utf-8"))


# ------------------------------------------------------------------------------------------------- every page


def test_training_ends_with_a_page_that_loads_nothing(trained: Path):
    page = Page((trained / "report.html").read_text("utf-8"))
    assert page.loaded == []
    assert page.unnamed == 0  # every picture has an alternative text
    assert page.scripts == 2  # the page's own scripts
    assert HOSTILE in page.text
    assert "<script>alert" not in page.html
    assert "default-src 'none'" in unescape(page.html)
    assert not list(trained.glob(".report*"))


def test_the_scripts_that_may_run_are_those_of_the_page(trained: Path):
    html = (trained / "report.html").read_text("utf-8")
    scripts = re.findall(r"<script>(.*?)</script>", html, re.DOTALL)
    named = re.search(r"script-src ([^\"]*)\"", unescape(html)).group(1).split()
    made = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    assert [name.strip("'").removeprefix("sha256-") for name in named] == made


def test_maps_are_shown_beside_their_truth(trained: Path):
    page = page_of(trained)
    layers = page.data["views-data"]["layers"]
    assert [layer["title"] for layer in layers] == [
        "Image, rendering equation",
        "Image, volume rendering",
        "Base colour",
        "Base colour, scaled",
        "Roughness",
        "Metallic",
        "Normal",
    ]
    assert all(
        cell["truth"].startswith("data:image/webp;base64,UklGR")
        for layer in layers
        for cell in layer["cells"]
    )
    assert "These views were held out of training" in page.text


def test_the_surface_is_that_of_the_run(trained: Path):
    packed = page_of(trained).data["surface-data"]
    raw = {
        name: base64.b64decode(packed[name]) for name in ("position", "normal", "color", "material", "index")
    }
    position = np.frombuffer(raw["position"], "<u2").reshape(-1, 3)
    index = np.frombuffer(raw["index"], "<u4").reshape(-1, 3)
    assert (len(position), len(index)) == (packed["vertices"], packed["faces"])
    assert len(raw["normal"]) == len(raw["color"]) == 3 * len(position)
    assert len(raw["material"]) == 2 * len(position)
    assert index.max() == len(position) - 1
    low, high = np.array(packed["low"]), np.array(packed["high"])
    place = low + position / 65535 * (high - low)
    normal = np.frombuffer(raw["normal"], "i1").reshape(-1, 3) / 127
    np.testing.assert_allclose(np.linalg.norm(normal, axis=-1), 1, atol=0.02)
    # The surface is still a ball around the origin: normals point away from it.
    assert ((place * normal).sum(-1) > 0).mean() > 0.95


def test_a_fine_surface_is_simplified_with_care(trained: Path, monkeypatch):
    """Measured: 0.0003. With the usual settings of the decimation it is 0.0025, because planes bend."""
    table, count = modelled(), 10_000
    assert len(table.faces) > 3 * count
    monkeypatch.setattr(report_surface, "FACES", count)
    monkeypatch.setattr(report_surface, "fine_surface", lambda run, resolution: table)
    monkeypatch.setattr(
        report_surface, "visible_faces", lambda surface, cameras: np.ones(len(table.faces), bool)
    )
    packed = report_surface.packed_surface(load_run(trained))
    assert packed["faces"] <= count
    low, high = np.array(packed["low"]), np.array(packed["high"])
    position = np.frombuffer(base64.b64decode(packed["position"]), "<u2").reshape(-1, 3) / 65535
    index = np.frombuffer(base64.b64decode(packed["index"]), "<u4").reshape(-1, 3)
    shown = creased(low + position * (high - low), index.astype(np.int64))
    assert distance_between(table, shown).near < 0.0006


def test_measured_figures_replace_those_of_the_shown_views(run: Path):
    before = page_of(run).text
    assert "not the figures of the protocol neilfpp" in before
    figures = {"pbr_psnr": 12.34, "base_color_psnr": 9.87, "base_color_psnr_frame": 11.5}
    (run / "metrics.json").write_text(json.dumps(figures | {"health": "sound"}))
    (run / "metrics-protocol.json").write_text(json.dumps({"mask_source": "true depth"}))
    text = page_of(run).text
    for name, value in figures.items():
        style = style_of(name.removesuffix("_frame"))
        assert style.format(value) in text
        assert style.meaning in text
    assert "mask source: true depth" in text
    assert "older than the checkpoint" not in text
    os.utime(run / "metrics.json", (0, 0))
    assert "older than the checkpoint" in page_of(run).text


def test_figures_of_published_protocols_are_shown_with_their_names(run: Path):
    measured = {"view_names": ["000", "004"], "width": 40, "height": 30, "step": 12}
    stored = {
        "protocol": "neilf-synthetic",
        "source": "apple/ml-neilfpp",
        "left_out": "nothing",
        "measured": measured,
        "figures": {"render_psnr": 23.45, "base_color_gamma": 0.9},
    }
    (run / "eval").mkdir()
    (run / "eval" / "neilf-synthetic.json").write_text(json.dumps(stored))
    (run / "eval" / "shiny-normals.json").write_text("{")
    (run / "eval" / "of-a-stranger.json").write_text(json.dumps(stored))
    text = page_of(run).text
    for words in (
        "Protocol neilf-synthetic",
        "23.45 dB",
        "source: apple/ml-neilfpp",
        "2 views of 40×30 pixels",
    ):
        assert words in text
    assert "shiny-normals.json: not readable as JSON" in text
    assert "stranger" not in text
    assert "neither is better" not in page_of(run).html


def test_a_finding_comes_with_its_cause_and_remedy(run: Path):
    finding = {
        "case": "fog",
        "severe": True,
        "step": 8,
        "what": "all fog",
        "cause": "few <views>",
        "remedy": "give masks",
    }
    (run / "health.json").write_text(json.dumps({"format": 1, "verdict": "failed", "findings": [finding]}))
    page = page_of(run)
    for words in ("Failed", "all fog", "few <views>", "give masks"):
        assert words in page.text
    assert "few <views>" not in page.html


def test_effects_and_times_are_shown_if_they_are_recorded(run: Path):
    row = {
        "effect": "lamps",
        "title": "Lamps nearby",
        "decision": "off",
        "reason": "0.1 <% ",
        "cost": "8 %",
        "risk": "none",
    }
    (run / "effects.json").write_text(
        json.dumps({"format": 1, "request": "as-set", "decisions": [], "effects": [row]})
    )
    (run / "work.json").write_text(
        json.dumps({"format": 1, "seconds": {"sdf_init": {"rendering": 61.0, "data": 20.0}}})
    )
    text = page_of(run).text
    assert "Lamps nearby" in text
    assert "1 min 21 s" in text
    assert "rendering 75 %" in text


@pytest.mark.parametrize(
    ("name", "contents", "said"),
    [
        ("timing.json", "{", "timing.json: not readable as JSON"),
        ("timing.json", '{"sdf_init": NaN}', "timing.json: sdf_init is not a finite number"),
        ("metrics.json", f'{{"pbr_psnr": 1{400 * "0"}}}', "metrics.json: pbr_psnr is not a finite number"),
        ("previews/joint.png", "no image", "previews/joint.png"),
        ("environment.json", '{"gpus": 5}', "none"),
    ],
)
def test_a_damaged_side_file_is_named_and_left_out(run: Path, name: str, contents: str, said: str):
    (run / name).write_text(contents)
    assert said in page_of(run).text


def test_each_preview_is_described_by_its_panels(run: Path):
    captions = [line for line in page_of(run).captions if line.startswith("End of ")]
    assert captions == [
        "End of SDF init: photograph, R, normal",
        "End of Material init: photograph, R, normal, PBR, base colour, roughness, metallic",
        "End of Joint: photograph, R, normal, PBR, base colour, roughness, metallic",
    ]
    for name, panels in (("sdf_init", 3), ("material_init", 7), ("joint", 7)):
        height, width, _ = read_files(run).previews[name].shape
        assert width == panels * height * 4 / 3  # the views of make_capture have 4 : 3


# ----------------------------------------------------------------------------------------------- unusual runs


def test_the_page_of_a_stopped_run_says_how_to_continue(run: Path):
    last_checkpoint(run).write_bytes(checkpoint_path(run, "sdf_init").read_bytes())
    page = page_of(run)
    assert "stopped after step 4 of 12" in page.text
    assert "--resume" in page.text
    assert "only the geometry is shown" in page.text
    assert "color" not in page.data["surface-data"]
    shutil.rmtree(last_checkpoint(run).parent)
    page = page_of(run)
    assert "stopped before its first checkpoint" in page.text
    assert page.data == {}
    messages: list[str] = []
    write_report(run, run / "report.html", SMALL, say=messages.append)
    assert [line.split(". ")[0] for line in messages] == ["the report has no views, surface and light"]
    assert "--resume" in messages[0]


def test_a_run_with_settings_only_has_no_report(run: Path, capfd):
    for path in run.iterdir():
        if path.name not in ("config.json", "capture.json", "scene.json", "effects.json"):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
    assert main(["report", str(run)]) == 2
    error = capfd.readouterr().err
    assert f"{run}: nothing to report" in error
    assert "before its first checkpoint" in error
    assert "--resume" in error
    assert not (run / "report.html").exists()


def test_photographs_without_truth_or_test_views_have_a_page(tmp_path: Path):
    root = make_capture(tmp_path / "photos", hdr=False, test=None)
    for part in ("inputs/depth_maps", "inputs/normal_maps", "ground_truths"):
        shutil.rmtree(root / part, ignore_errors=True)
    train_tiny(root, tmp_path / "run", "--test-every", "0", "--no-report")
    assert not (tmp_path / "run" / "report.html").exists()
    page = page_of(tmp_path / "run")
    for words in ("display values (LDR)", "No view is held out", "Nothing was measured"):
        assert words in page.text
    layers = {layer["title"]: layer for layer in page.data["views-data"]["layers"]}
    assert layers["Roughness"]["cells"][0]["truth"] is None
    assert page.data["views-data"]["photographs"][0].startswith("data:image/webp")


def test_a_given_mesh_has_its_page(tmp_path: Path):
    root = make_capture(tmp_path / "ball")
    mesh = root / "inputs" / "model" / "mesh.ply"
    if not mesh.is_file():
        pytest.fail("the capture has no mesh to give")
    train_tiny(root, tmp_path / "run", "--host", "mesh", "--no-report")
    packed = page_of(tmp_path / "run").data["surface-data"]
    assert packed["faces"] > 10_000  # divided, for its colours
    low, high = np.array(packed["low"]), np.array(packed["high"])
    np.testing.assert_allclose([low, high], [[-0.8] * 3, [0.8] * 3], atol=0.02)  # the ball of make_capture


@pytest.mark.parametrize("options", [["--views", "0"], ["--size", "5"], ["--views", "99"]])
def test_invalid_options_are_refused(trained: Path, options: list[str], tmp_path: Path, capsys):
    assert main(["report", str(trained), "--out", str(tmp_path / "page.html"), *options]) == 2
    assert options[0] in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_without_a_run_there_is_an_error(tmp_path: Path):
    with pytest.raises(UserError, match="no run here"):
        write_report(tmp_path, tmp_path / "report.html")
    assert not list(tmp_path.iterdir())


# ------------------------------------------------------------------------------------------------------ parts


def test_only_text_is_escaped():
    made = element("p", "a < b", element("b", "c"), None, title='"', hidden=False, data_x=1)
    assert made == '<p title="&quot;" data-x="1">a &lt; b<b>c</b></p>'
    assert isinstance(made, Html)
    assert element("img", alt="x") == '<img alt="x">'


def test_data_cannot_end_its_block():
    assert "</script" not in data_block("d", {"name": "</script><script>"}).removesuffix("</script>")
    assert json.loads(Page(data_block("d", {"a": 1})).html.split(">")[1].split("<")[0]) == {"a": 1}


def test_settings_are_compared_with_those_of_the_preset():
    assert changed_settings(preset("fast")) == []
    assert changed_settings(fixed_geometry(preset("fast"))) == []
    found = changed_settings(changed(preset("paper-ngp"), {"train.rays": 77}))
    assert [(c.name, c.value, c.preset_value) for c in found] == [("train.rays", "77", "4096")]
    assert changed_settings(changed(preset("fast"), {"preset": "mine"})) is None


def test_figures_are_numbers(run: Path):
    (run / "metrics.json").write_text('{"a": 1, "b": true, "c": "x", "d": [2]}')
    assert read_files(run).measured["neilfpp"].figures == {"a": 1.0}


def test_an_unknown_figure_has_no_better_direction():
    assert style_of("a_figure_of_another_version").better == "neither"
