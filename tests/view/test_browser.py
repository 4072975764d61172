"""The page in a real browser, if there is one: the layers, the light, and a click on the surface."""

from __future__ import annotations

import io
import shutil
import socket

import numpy as np
import pytest
from PIL import Image

from neilfpp_method.relight.sky import Sky
from neilfpp_method.train.run import load_run
from neilfpp_method.view.subject import LAYERS, subject_of

pytest.importorskip("viser")
pytest.importorskip("selenium")
if not (shutil.which("chromium") and shutil.which("chromedriver")):
    pytest.skip("no chromium with its driver on this machine", allow_module_level=True)

import torch

from neilfpp_method.view.browser import open_page
from scripts.viewer_screenshot import choose, chromium, click_at, text_of, wait_for


@pytest.fixture(scope="module")
def page(found):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    red = Sky(torch.tensor([0.9, 0.05, 0.05]).expand(8, 16, 3).contiguous(), True, 0.0)
    opened = open_page(subject_of(load_run(found), 32), {"red": red}, "127.0.0.1", port, "neilfpp view")
    with chromium() as driver:
        driver.get(f"http://127.0.0.1:{port}/")
        wait_for(lambda: "Layer" in text_of(driver))
        yield driver
    opened.stop()


def middle(driver) -> np.ndarray:
    """Mean colour around the centre of the window."""
    pixels = np.asarray(Image.open(io.BytesIO(driver.get_screenshot_as_png())).convert("RGB"), float)
    height, width = pixels.shape[:2]
    return pixels[int(0.45 * height) : int(0.55 * height), int(0.45 * width) : int(0.5 * width)].mean((0, 1))


def test_every_layer_is_shown(page):
    seen = {}
    for title in LAYERS.values():
        before = middle(page)
        choose(page, "Layer", title)
        if title != "PBR":  # it is shown first
            wait_for(lambda before=before: np.abs(middle(page) - before).max() > 2, 30)
        seen[title] = middle(page)
    assert np.ptp(seen["roughness"]) < 3  # grey
    assert np.ptp(seen["normal"]) > 20  # the centre of a ball faces the camera, and its normal is a colour


def test_another_environment_is_another_light(page):
    choose(page, "Layer", "PBR")
    choose(page, "Environment", "red")
    wait_for(lambda: middle(page)[0] > 2 * middle(page)[1], 30)
    choose(page, "Environment", "the run's own")
    wait_for(lambda: middle(page)[0] < 1.5 * middle(page)[1], 30)


def test_a_click_on_the_surface_shows_its_material(page):
    click_at(page, 0.48, 0.5)
    wait_for(lambda: "metallic 0." in text_of(page), 30)
    assert "Click the surface." not in text_of(page)


def test_going_to_a_view_shows_its_photograph(page):
    choose(page, "Layer", "normal")
    before = middle(page)
    from selenium.webdriver.common.by import By

    page.find_element(By.XPATH, "//label[text()='Go to']/following::input[1]").click()
    options = "//*[@role='option']"
    wait_for(lambda: sum(e.is_displayed() for e in page.find_elements(By.XPATH, options)) > 3, 10)
    shown = [e for e in page.find_elements(By.XPATH, options) if e.is_displayed()]
    shown[3].click()
    wait_for(lambda: "The photograph" in text_of(page), 30)
    wait_for(lambda: np.abs(middle(page) - before).max() > 2, 30)
