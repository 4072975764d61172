"""The page in a real browser: layers change the images, no script fails, and the page fits a phone."""

from __future__ import annotations

from pathlib import Path

import pytest

from neilfpp_method.report.write import ReportOptions, write_report
from tests.calls import train_tiny
from tests.data.make_capture import make_capture
from tests.report.browser import BROWSER, after

pytestmark = pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")

CLICK = """
  const stage = document.querySelector(".stage"), [before, now] = stage.querySelectorAll("img");
  const click = (name, value) => document.querySelector(`input[name=${name}][value="${value}"]`).click();
  const canvas = document.getElementById("surface-canvas"), gl = canvas.getContext("webgl2");
"""


@pytest.fixture(scope="module")
def page(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    root = make_capture(folder / "ball", masks=True, test=(0, 2))
    train_tiny(root, folder / "run", "--no-report")
    return write_report(folder / "run", folder / "report.html", ReportOptions(views=2, size=24))


def test_selecting_layers_changes_the_images(page: Path):
    said = after(
        page,
        CLICK
        + """
        const seen = [];
        for (const layer of document.querySelectorAll("input[name=layer]")) {
          layer.click();
          seen.push([now.src, before.src, now.alt]);
        }
        click("beside", "error");
        const error = before.src;
        click("view", 1);
        const strips = [...document.querySelectorAll(".strip[data-view]")]
            .map((s) => getComputedStyle(s).display);
        const slider = stage.querySelector("input");
        slider.value = 20;
        slider.dispatchEvent(new Event("input"));
        return { seen, error, strips, at: stage.style.getPropertyValue("--at"), alt: now.alt,
                 caption: document.getElementById("views-caption").textContent };
        """,
    )
    assert len({estimate for estimate, _, _ in said["seen"]}) == 7
    assert all(estimate != truth for estimate, truth, _ in said["seen"])
    assert said["seen"][4][2] == "Roughness, estimate, view 000"
    assert said["error"] not in said["seen"][-1][:2]
    assert said["strips"] == ["none", "grid"]
    assert said["at"] == "20%"
    assert said["alt"] == "Normal, estimate, view 002"
    assert "error on the left" in said["caption"]


def test_the_surface_is_drawn_layer_by_layer(page: Path):
    said = after(
        page,
        CLICK
        + """
        const found = {};
        for (const layer of document.querySelectorAll("input[name=surface-layer]")) {
          layer.click();
          await new Promise(requestAnimationFrame);  // asked for after the page's own
          const pixel = new Uint8Array(4);
          gl.readPixels(canvas.width / 2, canvas.height / 2, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, pixel);
          found[layer.value] = [...pixel];
        }
        return { found, said: document.getElementById("surface-status").textContent };
        """,
    )
    assert "triangles" in said["said"]
    pixels = said["found"]
    assert set(pixels) == {"0", "1", "2", "3", "4"}
    assert all(pixel[3] == 255 for pixel in pixels.values())  # the surface is drawn
    assert pixels["2"][0] == pixels["2"][1] == pixels["2"][2]  # roughness is grey
    assert len({tuple(pixel) for pixel in pixels.values()}) == 5


def test_the_page_fits_a_phone(page: Path):
    said = after(page, "return [document.documentElement.scrollWidth, innerWidth];", width=500)
    assert said[0] <= said[1]
