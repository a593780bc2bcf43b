"""The report in a real browser: what the browser displays, logs as errors and fetches."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.loops import output_of
from tests.support.report_log import SyntheticLog
from tests.support.viewers import Page, browser, needs_chromium, pixels

PICTURES = {"overview", "intervals", "residual", "spectra", "budget", "light", "timeline", "stroke"}
WIDTH = 1200

pytestmark = [pytest.mark.browser, needs_chromium]

# What a screenshot does not show: bounding boxes, images inside drawings, the height of the whole page.
MEASURE = """(async () => {
  const box = (element) => { const r = element.getBoundingClientRect(); return [r.left, r.top, r.width, r.height]; };
  const images = [...document.querySelectorAll("image, img")].map(async (element) => {
    const copy = new Image();
    copy.src = element.href?.baseVal ?? element.src;
    try { await copy.decode(); } catch { return 0; }
    return copy.naturalWidth * copy.naturalHeight * element.getBoundingClientRect().width;
  });
  document.querySelectorAll("details").forEach((element) => { element.open = true; });
  const text = document.body.innerText;
  document.querySelectorAll("details").forEach((element) => { element.open = false; });
  return {
    text: text.replace(/\\s+/g, " "),
    pictures: Object.fromEntries([...document.querySelectorAll("figure > svg")].map(
      (element) => [element.getAttribute("aria-label"), box(element)])),
    images: await Promise.all(images),
    overflow: document.documentElement.scrollWidth - document.documentElement.clientWidth,
    height: document.documentElement.scrollHeight,
  };
})()"""


def measured(page: Page) -> dict[str, Any]:
    answer = page.call("Runtime.evaluate", expression=MEASURE, awaitPromise=True, returnByValue=True)
    return dict(answer["result"]["value"])


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("report")


@pytest.fixture(scope="module")
def results(folder: Path) -> dict[str, Any]:
    """Results of a run with requests and a warning, printed by the command that also writes the page."""
    night = SyntheticLog().request("open").frames(150).request("close").frames(900, lost={300})
    log = night.write(folder / "night.mcap")
    found: dict[str, Any] = json.loads(output_of(folder, f"lowfc report {log} --json --out report.html"))
    return found


@pytest.fixture(scope="module")
def page(folder: Path, results: dict[str, Any]) -> Iterator[Page]:
    with browser(folder, (WIDTH, 1000)) as opened:
        opened.open((folder / "report.html").as_uri())
        yield opened


@pytest.fixture(scope="module")
def measurements(page: Page) -> dict[str, Any]:
    return measured(page)


def test_the_report_has_no_browser_errors_and_fetches_nothing_remote(page: Page, measurements: dict[str, Any]) -> None:
    assert measurements["pictures"]
    assert page.complaints == []
    assert {address.partition(":")[0] for address in page.fetched.values()} <= {"file", "data"}


def test_every_picture_is_drawn_within_the_page(measurements: dict[str, Any]) -> None:
    assert set(measurements["pictures"]) == PICTURES
    for name, (left, _, width, height) in measurements["pictures"].items():
        assert width > 600, name
        assert height > 100, name
        assert left >= 0, name
    assert len(measurements["images"]) >= 2  # the mirror's map and its scale
    assert min(measurements["images"]) > 0
    assert measurements["overflow"] <= 0


def test_the_text_contains_the_values_of_the_json(measurements: dict[str, Any], results: dict[str, Any]) -> None:
    text, budget = measurements["text"], results["error_budget"]
    headings = ("Wavefront", "Timing", "Spectra", "Error budget", "Light", "Mirror", "Events and requests", "What ran")
    expected = [results["verdict"]["heading"], *headings, results["run"]["calibration"]["id"]]
    expected += [check["text"] for check in results["verdict"]["checks"]]
    for mode in results["residual"]["modes"]:
        expected += [f"Z{mode['noll']} {mode['name']}", f"{mode['error_rms_nm']:.3f}"]
    expected += [f"{stage['p99']:.1f}" for stage in results["timing"]["latency_us"].values()]
    expected += [term[key] for term in budget["terms"] for key in ("name", "how")]
    expected.append(f"{budget['true_residual']['rms_nm']['all modes']:.3f}")
    expected.append("rate_hz = 250.0")  # from the configuration, which the page shows folded
    assert [part for part in expected if part not in text] == []


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_the_pictures_are_visible_in_light_and_dark_mode(
    page: Page, measurements: dict[str, Any], artefacts: Path, scheme: str
) -> None:
    page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
    size = {"width": WIDTH, "height": measurements["height"], "deviceScaleFactor": 1, "mobile": False}
    page.call("Emulation.setDeviceMetricsOverride", **size)
    picture = page.screenshot_when(lambda shown: (float(shown[2, 2].mean()) < 40) == (scheme == "dark"), 20)
    (artefacts / f"report-{scheme}.png").write_bytes(picture)
    shown = pixels(picture)
    assert shown.shape == (measurements["height"], WIDTH, 3)
    background = float(shown[2, 2].mean())
    assert (background < 40) == (scheme == "dark")
    for name, (left, top, width, height) in measurements["pictures"].items():
        region = shown[int(top) : int(top + height), int(left) : int(left + width)]
        brightness = region.mean(axis=2, dtype=np.float32)
        # Lines and letters, brighter or darker than the background, cover a part of the picture.
        drawn = np.abs(brightness - background) > 60
        assert 0.005 < drawn.mean() < 0.9, name
        assert drawn.any(axis=1).mean() > 0.5, f"{name} fills more than half of its height"
        assert drawn.any(axis=0).mean() > 0.5, f"{name} fills more than half of its width"
        assert region.std() > 5, name
    assert np.ptp(shown[::3, ::3], axis=2).max() > 80, "the pictures have colours"


def test_the_checks_detect_a_broken_page(folder: Path, page: Page) -> None:
    wrong = folder / "wrong.html"
    wrong.write_text(
        "<!DOCTYPE html><body><img src='http://127.0.0.1:9/picture.png'><script>throw new Error('broken')</script>"
        "<div style='width: 3000px'>wide</div></body>"
    )
    page.open(wrong.as_uri())
    found = measured(page)
    assert any("broken" in line for line in page.complaints)
    assert "http://127.0.0.1:9/picture.png" in page.fetched.values()
    assert found["images"] == [0]
    assert found["overflow"] > 0
