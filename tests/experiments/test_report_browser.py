"""A report in a real browser: `scripts/setup --with-browser` installs one where there is none."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from crptpro.experiments.report.html import POLICY

pytestmark = pytest.mark.slow  # the page with everything takes a while to be made

BROWSERS = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
DARK, LIGHT = 0, 1
"""What Chromium calls the two colour schemes."""


@pytest.fixture(scope="module")
def page(whole_report: Path) -> Path:
    return whole_report


def browse(
    page: Path, *arguments: str, width: int = 1200, scheme: int = LIGHT
) -> subprocess.CompletedProcess[str]:
    """Open a page without a network, in a profile of its own."""
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    assert browser is not None, (
        f"No browser was found ({', '.join(BROWSERS)}); `scripts/setup --with-browser` installs one."
    )
    command = [
        browser, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--no-first-run",
        "--host-resolver-rules=MAP * ~NOTFOUND", "--proxy-server=127.0.0.1:9", "--enable-logging=stderr",
        f"--user-data-dir={page.parent / 'profile'}", f"--blink-settings=preferredColorScheme={scheme}",
        f"--window-size={width},1400", *arguments, page.as_uri(),
    ]  # fmt: skip
    return subprocess.run(command, capture_output=True, text=True, timeout=100, check=True)


def measured(page: Path, expression: str, width: int) -> str:
    """What a script says of the page; only a copy that allows scripts can be asked."""
    text = page.read_text().replace(POLICY, "default-src 'unsafe-inline' data:")
    copy = page.with_name("measured.html")
    copy.write_text(
        text.replace("</body>", f"<script>document.title = 'said ' + ({expression})</script></body>")
    )
    found = re.search(r"<title>said ([^<]*)</title>", browse(copy, "--dump-dom", width=width).stdout)
    assert found is not None
    return found[1]


def test_the_browser_shows_every_section_and_misses_nothing(page: Path) -> None:
    seen = browse(page, "--dump-dom")
    assert seen.stdout.count("<section") == page.read_text().count("<section") >= 18
    complaints = [line for line in seen.stderr.splitlines() if "CONSOLE" in line or "Refused" in line]
    assert complaints == []


@pytest.mark.parametrize("width", [1200, 400])
def test_the_page_never_scrolls_sideways_and_pictures_have_a_size(page: Path, width: int) -> None:
    assert measured(page, "document.documentElement.scrollWidth <= innerWidth", width) == "true"
    flat = "[...document.querySelectorAll('figure svg, figure img')].filter(e => e.getBoundingClientRect().width < 100)"
    assert measured(page, f"{flat}.length", width) == "0"


def test_a_page_is_light_or_dark_as_the_reader_wants(page: Path, tmp_path: Path) -> None:
    shades = {}
    for name, scheme in (("light", LIGHT), ("dark", DARK)):
        picture = tmp_path / f"{name}.png"
        browse(page, f"--screenshot={picture}", scheme=scheme)
        pixels = imread(picture)[..., :3].mean(axis=-1)
        shades[name] = (float(np.median(pixels)), float(np.ptp(pixels)))
    assert shades["light"][0] > 0.9
    assert shades["dark"][0] < 0.2
    assert min(contrast for _, contrast in shades.values()) > 0.7
