"""A headless Chromium for tests of pages, with a screen of any size, light or dark."""

import shutil

import pytest

webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed (extra dev)")

from selenium.webdriver.common.by import By  # noqa: E402

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
DRIVER = shutil.which("chromedriver")
SOCKETS = pytest.mark.filterwarnings("ignore::ResourceWarning")
"""For modules with a browser, whose driver's library leaves sockets to be closed by the collector."""
FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--disable-background-networking",
    "--disable-component-update", "--disable-sync", "--no-first-run", "--disable-dev-shm-usage",
)  # fmt: skip


def opened(profile):
    """A browser with its profile in a folder; the test is skipped where there is none."""
    if not (CHROMIUM and DRIVER):
        pytest.skip("chromium or its driver (Debian: chromium-driver) is not here")
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in (*FLAGS, f"--user-data-dir={profile}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    return webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))


def screen(browser, width, height=900, *, dark=False):
    """The size of the window, and what the reader's system prefers."""
    size = {"width": width, "height": height, "deviceScaleFactor": 2, "mobile": width < 500}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    # Without motion a page that scrolls is where it is going at once.
    still = {"name": "prefers-reduced-motion", "value": "reduce"}
    browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme, still]})


def one(page, css):
    return page.find_element(By.CSS_SELECTOR, css)


def every(page, css):
    return page.find_elements(By.CSS_SELECTOR, css)


def painted(page, css):
    """How many colours there are on a canvas."""
    script = """
    const c = document.querySelector(arguments[0]);
    const d = c.getContext("2d").getImageData(0, 0, c.width, c.height).data;
    const seen = new Set();
    for (let i = 0; i < d.length; i += 16) seen.add(d[i] * 65536 + d[i + 1] * 256 + d[i + 2]);
    return seen.size;
    """
    return page.execute_script(script, css)
