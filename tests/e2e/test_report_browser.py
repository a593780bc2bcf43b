"""The report in a real browser: what is on the screen, what the browser complains of, what it fetches."""

import html as markup
import json
import re
import shutil
import socket
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from tests.support.loops import run
from tests.support.report_log import Night

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
PICTURES = {"overview", "intervals", "residual", "spectra", "budget", "light", "timeline", "stroke"}
WIDTH = 1200
DARK = "--blink-settings=preferredColorScheme=0"

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(CHROMIUM is None, reason="no browser is installed: apt install chromium"),
]

# What a person cannot see in a picture of the page: boxes, pictures inside of drawings, what was fetched.
MEASURE = """<pre id="measured"></pre><script>
addEventListener("load", async () => {
  const box = (one) => { const r = one.getBoundingClientRect(); return [r.left, r.top, r.width, r.height]; };
  const images = [...document.querySelectorAll("image, img")].map(async (one) => {
    const copy = new Image();
    copy.src = one.href?.baseVal ?? one.src;
    try { await copy.decode(); } catch { return 0; }
    return copy.naturalWidth * copy.naturalHeight * one.getBoundingClientRect().width;
  });
  document.getElementById("measured").textContent = JSON.stringify({
    pictures: Object.fromEntries([...document.querySelectorAll("figure > svg")].map(
      (one) => [one.getAttribute("aria-label"), box(one)])),
    images: await Promise.all(images),
    fetched: performance.getEntriesByType("resource").map((one) => one.name),
    overflow: document.documentElement.scrollWidth - document.documentElement.clientWidth,
    height: document.documentElement.scrollHeight,
  });
});
</script>"""


@dataclass(frozen=True)
class Seen:
    """A page as the browser has it."""

    text: str
    measured: dict[str, Any]
    complaints: list[str]


def chromium(folder: Path, *words: str) -> "subprocess.CompletedProcess[str]":
    quiet = ("gpu", "quic", "background-networking", "component-update", "sync", "default-apps", "extensions")
    return subprocess.run(
        [
            str(CHROMIUM),
            *("--headless", "--no-sandbox", "--no-first-run", "--enable-logging=stderr", "--hide-scrollbars"),
            *(f"--disable-{name}" for name in quiet),
            *(f"--user-data-dir={folder / 'profile'}", f"--window-size={WIDTH},1000", "--virtual-time-budget=4000"),
            *words,
        ],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def look(folder: Path, page: str) -> Seen:
    """Load a page, with what measures it at its end; its own policy would not let that run."""
    path = folder / "measured.html"
    policy = r'<meta http-equiv="Content-Security-Policy"[^>]*>'
    path.write_text(re.sub(policy, "", page).replace("</body>", f"{MEASURE}</body>"))
    done = chromium(folder, "--dump-dom", path.as_uri())
    shutil.rmtree(folder / "profile", ignore_errors=True)
    found = re.search(r'<pre id="measured">(.+?)</pre>', done.stdout)
    assert found is not None, done.stderr
    text = re.sub(r"\s+", " ", markup.unescape(re.sub(r"<[^>]+>", " ", done.stdout)))
    complaints = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return Seen(text, json.loads(markup.unescape(found[1])), complaints)


def shoot(folder: Path, page: Path, height: int, *words: str) -> npt.NDArray[np.uint8]:
    """Pixels (rows, columns, 3) of a page."""
    from PIL import Image

    target = folder / "page.png"
    chromium(folder, f"--screenshot={target}", f"--window-size={WIDTH},{height}", *words, page.as_uri())
    shutil.rmtree(folder / "profile", ignore_errors=True)
    with Image.open(target) as picture:
        return np.asarray(picture.convert("RGB"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("report")


@pytest.fixture(scope="module")
def figures(folder: Path) -> dict[str, Any]:
    """Figures of a run with a request and a warning in it, from the command that writes the page too."""
    night = Night()
    night.request("open")
    night.frames(150)
    night.request("close")
    night.frames(900, lost={300})
    log = night.write(folder / "night.mcap")
    done = run(folder, "report", str(log), "--json", "--out", "report.html")
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.fixture(scope="module")
def page(folder: Path, figures: dict[str, Any]) -> Path:
    return folder / "report.html"


@pytest.fixture(scope="module")
def seen(folder: Path, page: Path) -> Seen:
    return look(folder, page.read_text())


def test_the_browser_has_nothing_to_complain_of(seen: Seen) -> None:
    assert seen.complaints == []
    assert seen.measured["fetched"] == []


def test_what_is_wrong_would_be_found(folder: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"http://127.0.0.1:{free.getsockname()[1]}/picture.png"
    broken = (
        f"<!DOCTYPE html><body><img src='{address}'><script>throw new Error('broken')</script>"
        "<div style='width: 3000px'>wide</div></body>"
    )
    found = look(folder, broken)
    assert any("broken" in line for line in found.complaints)
    assert set(found.measured["fetched"]) == {address}  # asked for by the page, and once more to measure it
    assert found.measured["images"] == [0]
    assert found.measured["overflow"] > 0


def test_every_picture_is_there_and_has_a_size(seen: Seen) -> None:
    assert set(seen.measured["pictures"]) == PICTURES
    for name, (left, _, width, height) in seen.measured["pictures"].items():
        assert width > 600, name
        assert height > 100, name
        assert left >= 0, name
    assert len(seen.measured["images"]) >= 2  # the mirror's map and its scale
    assert min(seen.measured["images"]) > 0
    assert seen.measured["overflow"] <= 0


def test_the_text_says_what_the_figures_say(seen: Seen, figures: dict[str, Any]) -> None:
    headings = ("Wavefront", "Timing", "Spectra", "Error budget", "Light", "Mirror", "Events and requests", "What ran")
    for heading in (figures["verdict"]["heading"], *headings):
        assert heading in seen.text
    for check in figures["verdict"]["checks"]:
        assert check["text"] in seen.text
    assert figures["run"]["calibration"]["id"] in seen.text
    for mode in figures["residual"]["modes"]:
        assert f"Z{mode['noll']} {mode['name']}" in seen.text
        assert f"{mode['error_rms_nm']:.3f}" in seen.text
    for stage in figures["timing"]["latency_us"].values():
        assert f"{stage['p99']:.1f}" in seen.text
    for term in figures["error_budget"]["terms"]:
        assert term["name"] in seen.text
        assert term["how"] in seen.text
    assert f"{figures['error_budget']['true_residual']['rms_nm']['all modes']:.3f}" in seen.text
    assert "rate_hz = 250.0" in seen.text  # the configuration, folded


@pytest.mark.parametrize(("words", "dark"), [((), False), ((DARK,), True)], ids=["light", "dark"])
def test_it_can_be_read_in_light_and_in_the_dark(
    folder: Path, page: Path, seen: Seen, artefacts: Path, words: tuple[str, ...], dark: bool
) -> None:
    height = seen.measured["height"]
    pixels = shoot(folder, page, height, *words)
    assert pixels.shape == (height, WIDTH, 3)
    (artefacts / f"report-{'dark' if dark else 'light'}.png").write_bytes((folder / "page.png").read_bytes())
    paper = float(pixels[2, 2].mean())
    assert (paper < 40) == dark
    for name, (left, top, width, tall) in seen.measured["pictures"].items():
        region = pixels[int(top) : int(top + tall), int(left) : int(left + width)]
        brightness = region.mean(axis=2, dtype=np.float32)
        # Lines and letters cover some of it, and stand out from the paper.
        drawn = np.abs(brightness - paper) > 60
        assert 0.005 < drawn.mean() < 0.9, name
        assert drawn.any(axis=1).mean() > 0.5, f"{name} is empty over half of its height"
        assert drawn.any(axis=0).mean() > 0.5, f"{name} is empty over half of its width"
        assert region.std() > 5, name
    assert np.ptp(pixels[::3, ::3], axis=2).max() > 80, "there is no colour in it"
