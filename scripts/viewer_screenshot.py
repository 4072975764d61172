"""The viewer's page in a headless Chromium, clicked through and pictured: python scripts/viewer_screenshot.py
RUN PICTURE.

Needs the extra `view`, selenium, and Debian's packages chromium and chromium-driver.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from neilfpp_method.data.files.images import read_image
from neilfpp_method.train.run import load_run
from neilfpp_method.view.browser import open_page
from neilfpp_method.view.subject import subject_of

PORT = 8089
OPTIONS = (
    "--headless",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--window-size=1280,940",
)
NOTICE = "Software WebGL"
"""What viser says of a machine without a GPU."""


@contextmanager
def chromium() -> Iterator:
    """A headless Chromium with an empty profile."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = shutil.which("chromium")
    with tempfile.TemporaryDirectory() as profile:
        for option in (*OPTIONS, f"--user-data-dir={profile}"):
            options.add_argument(option)
        service = webdriver.ChromeService(shutil.which("chromedriver"))
        driver = webdriver.Chrome(options, service)
        try:
            yield driver
        finally:
            driver.quit()


def text_of(driver) -> str:
    return driver.execute_script("return document.body.innerText")


def wait_for(condition, seconds: float = 60.0) -> None:
    """Until something is so.

    Raises:
        TimeoutError: it was not, for so long.
    """
    ends = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > ends:
            raise TimeoutError(f"nothing came in {seconds:g} s")
        time.sleep(0.1)


def choose(driver, label: str, option: str) -> None:
    """An option of one of the page's lists."""
    from selenium.webdriver.common.by import By

    box = driver.find_element(By.XPATH, f"//label[text()='{label}']/following::input[1]")
    box.click()
    found = f"//*[@role='option'][normalize-space()=\"{option}\"]"
    wait_for(lambda: any(e.is_displayed() for e in driver.find_elements(By.XPATH, found)), 10)
    next(e for e in driver.find_elements(By.XPATH, found) if e.is_displayed()).click()


def click_at(driver, across: float, down: float) -> None:
    """A place of the window, in shares of it."""
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.by import By

    canvas = driver.find_element(By.TAG_NAME, "canvas")
    size = canvas.size
    x, y = round((across - 0.5) * size["width"]), round((down - 0.5) * size["height"])
    ActionChains(driver).move_to_element_with_offset(canvas, x, y).pause(0.2).click().perform()


def main(run: Path, picture: Path) -> None:
    page = open_page(subject_of(load_run(run), 256), {}, "127.0.0.1", PORT, "neilfpp view")
    try:
        with chromium() as driver:
            driver.get(f"http://127.0.0.1:{PORT}/")
            wait_for(lambda: "samples a pixel" in text_of(driver), 120)
            for button in driver.find_elements(
                "xpath", f"//*[contains(text(),'{NOTICE}')]/following::button[1]"
            ):
                button.click()
            click_at(driver, 0.38, 0.62)
            wait_for(lambda: "roughness 0" in text_of(driver))
            wait_for(lambda: " 32 samples" in text_of(driver), 400)
            driver.save_screenshot(str(picture))
            print(f"{picture}: {read_image(picture).pixels.shape[1]} columns")
    finally:
        page.stop()


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
