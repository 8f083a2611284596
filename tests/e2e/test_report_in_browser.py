"""The reports of runs in a headless Chromium: what a user does, on a desk and on a phone, without a message or a request."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from photonpano import compare
from photonpano.pipeline.run import RunResult

BRIGHTNESS = """(() => {
  const canvas = document.querySelector("#viewer canvas");
  const pixels = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
  return pixels.reduce((sum, value, k) => k % 4 === 0 ? sum + value : sum, 0) / pixels.length;
})()"""


@pytest.fixture(scope="module")
def report(small_run: RunResult) -> Path:
    return small_run.directory / "report.html"


@pytest.fixture
def opened(browser_page: Any, report: Path) -> Any:
    page = browser_page
    page.open(report)
    page.wait_for('document.querySelector("#viewer.live")')
    return page


def settled(page: Any, what: str) -> Any:
    """Return a value once what was asked for is drawn."""
    page.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return page.run(what)


def put(page: Any, label: str, value: float) -> None:
    """Move a slider, or choose from a list, by its label."""
    page.run(f"""(() => {{
      const input = document.querySelector('[aria-label="{label}"]');
      input.value = {value};
      input.dispatchEvent(new Event(input.tagName === "SELECT" ? "change" : "input"));
    }})()""")


def box(page: Any, what: str) -> tuple[float, float, float, float]:
    """Scroll to an element, and return its left and top edge, width and height."""
    page.run(f"document.querySelector('{what}').scrollIntoView({{block: 'center'}})")
    found = page.run(
        f"(({{x, y, width, height}}) => [x, y, width, height])(document.querySelector('{what}').getBoundingClientRect())"
    )
    return found[0], found[1], found[2], found[3]


@pytest.mark.parametrize("dark", [False, True])
@pytest.mark.parametrize("width", [400, 1400])
def test_page_fits_and_is_silent(browser_page: Any, report: Path, width: int, dark: bool) -> None:
    page = browser_page
    page.open(report, width, dark=dark)
    page.wait_for('document.querySelector("#viewer.live")')
    for index in range(4):
        put(page, "Map over the panorama", index % 4)
        settled(page, "0")
    assert page.run("document.documentElement.scrollWidth") == width
    assert (page.messages, page.requests) == ([], [])


def test_flux_under_the_mouse_is_that_of_the_tiff(opened: Any, report: Path) -> None:
    flux = tifffile.imread(report.with_name("panorama.tiff"))
    left, top, width, height = box(opened, "#viewer canvas")
    opened.mouse("mouseMoved", left + width / 2 + 10, top + height / 2 + 7)
    text = opened.run('document.querySelector(".readout").textContent')
    x, y, shown = re.fullmatch(r"x (\d+), y (\d+): ([\d.]+)", text).groups()
    assert float(shown) == pytest.approx(flux[int(y), int(x)], rel=0.01)


def test_exposure_brightens_what_is_linear(opened: Any) -> None:
    put(opened, "Exposure in stops", -2)
    dark = settled(opened, BRIGHTNESS)
    put(opened, "Exposure in stops", 0)
    normal = settled(opened, BRIGHTNESS)
    put(opened, "Exposure in stops", 2)
    bright = settled(opened, BRIGHTNESS)
    assert 1.3 * dark < normal < bright / 1.1
    assert "+2.0 stops" in opened.run("document.querySelector('#viewer').textContent")


def test_panorama_is_zoomed_and_dragged(opened: Any) -> None:
    left, top, width, height = box(opened, "#viewer canvas")
    middle = left + width / 2, top + height / 2
    shown = "document.querySelector('#viewer canvas').toDataURL()"
    whole = settled(opened, shown)
    opened.drag(middle, (middle[0] - 90, middle[1]))
    assert settled(opened, shown) == whole  # all of it is shown already
    opened.mouse("mouseWheel", *middle, deltaX=0, deltaY=-400)  # the canvas was clicked
    zoomed = settled(opened, shown)
    assert zoomed != whole
    opened.drag(middle, (middle[0] - 90, middle[1]))
    dragged = settled(opened, shown)
    assert dragged not in (zoomed, whole)
    opened.key("0")
    assert settled(opened, shown) == whole


def test_maps_and_path_are_drawn_over_the_panorama(opened: Any) -> None:
    shown = "document.querySelector('#viewer canvas').toDataURL()"
    pictures = [settled(opened, shown)]
    for index in range(1, 6):
        put(opened, "Map over the panorama", index)
        pictures.append(settled(opened, shown))
    assert "photon noise" in opened.run("document.querySelector('.legend').textContent")
    put(opened, "Map over the panorama", 0)
    opened.run("document.querySelector('#viewer input[type=checkbox]').click()")
    pictures.append(settled(opened, shown))
    assert len(set(pictures)) == 7


def test_pictures_of_one_instant_show_the_same_place(opened: Any) -> None:
    """Each exposure, laid on the shared frame, is like the panorama there: what is shown is aligned."""
    correlations = opened.run("""(async () => {
      const views = JSON.parse(document.getElementById("viewer-data").textContent).views;
      const pixels = await Promise.all(views.map(async (view) => {
        const image = new Image();
        image.src = view.uri;
        await image.decode();
        const canvas = document.createElement("canvas");
        [canvas.width, canvas.height] = [image.width, image.height];
        const context = canvas.getContext("2d");
        context.drawImage(image, 0, 0);
        return [...context.getImageData(0, 0, image.width, image.height).data].filter((_, k) => k % 4 === 0);
      }));
      return pixels;
    })()""")
    last = np.array(correlations[-1], float)
    seen = last > 0
    alike = [np.corrcoef(np.array(each, float)[seen], last[seen])[0, 1] for each in correlations[:-1]]
    frame, average, *levels = alike
    assert min(levels) > 0.75 > average
    assert levels == sorted(levels) or levels[-1] > levels[0]
    assert frame > 0


def test_page_without_script_shows_its_pictures(browser_page: Any, report: Path) -> None:
    page = browser_page
    page.open(report, script=False)
    page.call("Emulation.setScriptExecutionDisabled", value=False)
    assert page.run("document.querySelector('#viewer img').getBoundingClientRect().height") > 50
    assert page.run("document.querySelectorAll('canvas, #before-and-after, button').length") == 0
    assert page.run("document.querySelectorAll('svg').length") >= 6


def test_panoramas_of_runs_blink(browser_page: Any, small_run: RunResult, tmp_path: Path) -> None:
    shutil.copytree(small_run.directory, tmp_path / "again")
    page, opened = compare([small_run.directory, tmp_path / "again"], tmp_path / "page.html").page, browser_page
    opened.open(page, 400)
    shown = "[...document.querySelectorAll('#blink figure')].map((each) => each.getBoundingClientRect().height > 0)"
    assert opened.run(shown) == [True, False]
    opened.run("document.querySelectorAll('.row button')[2].click()")
    assert opened.run(shown) == [False, True]
    opened.run("document.querySelectorAll('.row button')[0].click()")
    opened.wait_for(f"{shown}[0]")
    opened.wait_for(f"{shown}[1]")
    assert opened.run("document.documentElement.scrollWidth") == 400
    assert (opened.messages, opened.requests) == ([], [])
    opened.open(page, script=False)
    opened.call("Emulation.setScriptExecutionDisabled", value=False)
    assert opened.run(shown) == [True, True]


def test_links_lead_to_files(opened: Any, report: Path) -> None:
    links = opened.run("[...document.querySelectorAll('.files a')].map((each) => each.href)")
    assert {link.rpartition("/")[2] for link in links} == {file.name for file in report.parent.iterdir()} - {"report.html"}
