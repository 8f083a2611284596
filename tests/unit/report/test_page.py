"""Pages of finished and failed runs: what they say, and that they need nothing from outside."""

import ast
import re
import subprocess
import sys
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from ruamel.yaml import YAML

from photonpano import FrameSpan, Group, NotLocated
from photonpano.errors import LocationError
from photonpano.motion.diagnosis import UntiedError
from photonpano.report import figures, render_failure, render_report
from photonpano.values import Edge


@pytest.fixture
def no_figures(monkeypatch):
    """Leave out the figures, whose drawing takes a second, where a test is about the words."""
    of_motion = "path_over_time", "path_on_panorama", "coverage_map"
    for name in (*of_motion, "chi2_over_panorama", "over_sensor", "shifts_over_time", "halves_over_time"):
        monkeypatch.setattr(figures, name, lambda *_: "")


@pytest.fixture
def page(record, explained, panorama, no_figures):
    """Return the page of a run whose record is changed; `motion` holds changes of the motion."""

    def page(rendered=panorama, motion=None, **changes):
        found = explained if motion is None else replace(explained, motion=replace(explained.motion, **motion))
        return render_report(record | changes, found, rendered)

    return page


@pytest.fixture
def text(page):
    """Return the text of such a page."""
    return lambda *given, **changes: text_of(page(*given, **changes))


def text_of(page: str) -> str:
    """Return what a reader sees, each run of white space as one blank."""
    body = ElementTree.fromstring(page).find("body")
    return " ".join(" ".join(body.itertext()).split())


def check_self_contained(page: str) -> None:
    """Fail unless the page is well formed, needs nothing from outside, and gives every element a name of its own."""
    tree = ElementTree.fromstring(page)
    references = [value for element in tree.iter() for name, value in element.attrib.items() if name in ("src", "href")]
    references += re.findall(r"url\(([^)]*)\)", page)
    assert all(re.match(r"#|\./|data:image/(jpeg|png);base64,", reference) for reference in references), references
    assert {reference for reference in references if reference.startswith("./")} <= {
        element.attrib.get("href") for element in tree.iter("a")
    }
    assert not re.search(r"@import|@font-face", page)
    scripts = set() if 'id="ties"' in page else {"script"}
    assert not {element.tag for element in tree.iter()} & ({"link", "iframe", "object", "base"} | scripts)
    names = [element.attrib["id"] for element in tree.iter() if "id" in element.attrib]
    assert len(names) == len(set(names))
    targets = {reference[1:] for reference in references if reference.startswith("#")}
    assert targets <= set(names)


def test_page_is_self_contained_and_deterministic(record, explained, panorama):
    page = render_report(record, explained, panorama)
    assert page == render_report(record, explained, panorama)
    check_self_contained(page)
    assert "http" not in page
    assert page.count("data:image/jpeg") == 2
    assert page.count("<svg") == 8


def test_page_shows_facts_warnings_and_failures(text, panorama):
    found = text()
    height, width = panorama.canvas.shape
    for sentence in (
        "photonpano 0.1.0 done doubtful corridor-pan",
        "10,000 binary frames of 496 x 254 px (width x height) at 96.8 kHz, 103 ms. 14 March 2026, 15:09 UTC",
        "Do not rely on this panorama yet: The light changes over time (most at frames 0 to 15) . "
        "The figure is 0.25; up to 0.03 is trusted. What to do: keep the light steady.",
        "scatter of short spans 1.01",
        "Each span of 16 frames is compared",
        "Over the whole capture it is 1.",
        "short-spans moved the frames by 0.66 px on average, in 2 rounds: tremor at 223 Hz; a little more.",
        "other found nothing to correct.",
        "The shifts of parts of the frame are not larger than their noise.",
        "level 2: 1 of 79 groups was not located (frames 9,125 to 9,374); the motion is interpolated across it",
        f"The panorama, {width} x {height} px at scale 1; 99 % of it was seen; white is 1.83 photons per pixel per frame.",
        "located, last level 157 of 157 groups",
        "change in the last level 0.063 px",
        "time 1 min 23 s",
        "peak memory 812 MiB",
        "Chosen from the capture group_size : 250 \N{EN DASH} at 0.15 px per frame groups of 250 frames are blurred by 38 px",
        "250 frames of 10,000 were not located: 0 to 124; 9,875 to 9,999 (counted from 0; their motion is",
        "the images overlap by 4% (at least 10% is needed)",
        "9,000 to 9,249 against 9,125 to 9,374",
        "for example: only 7 of 31 matches agree with one homography (at least 20 are needed)",
        "and 6 more pairs; all are in run.json",
        "Seed 0.",
        "opencv-sift",
        "opencv-python-headless 5.0.0.93",
        "From examples/pipelines/corridor-pan.yaml , with all defaults filled in.",
    ):
        assert sentence in found


def test_page_has_the_resolved_spec_and_a_row_for_each_level_with_names_for_a_phone(record, page):
    tree = ElementTree.fromstring(page())
    assert YAML(typ="safe").load("".join(tree.find(".//pre").itertext())) == record["spec"]
    [table] = [table for table in tree.iter("table") if "levels" in table.get("class", "")]
    rows = [["".join(cell.itertext()) for cell in row] for row in table.find("tbody")]
    dash = "\N{EN DASH}"
    assert rows == [
        ["1", "1", "40", "250", "40", "39", "0", "0", dash, "0.21", "0.42", "0.00", "2.41", "9.30", "0.02"],
        ["2", "1", "79", "250", "78", "78", "10", "11 of 12", "1.83", "0.1", "0.21", "0.00", "4.76", "18.37", "0.04"],
        ["3", "1", "157", "250", "157", "156", "0", "22 of 24", "0.063", "0.07", "0.14", "0.00", "9.46", "36.50", "0.08"],
    ]
    assert all(cell.get("data-name") for row in table.find("tbody") for cell in row)


HOSTILE = '</pre></style><script>alert("1")</script><img src="http://example.org/x.png"/>&amp;'


def test_page_escapes_all_input(record, page):
    record["spec_file"] = HOSTILE
    record["status"] = HOSTILE
    record["warnings"] = [HOSTILE]
    record["decisions"][0]["reason"] = HOSTILE
    record["levels"][1]["failures"][0]["reason"] = HOSTILE
    record["spec"]["source"]["with"]["path"] = HOSTILE
    record["plugins"][0]["use"] = HOSTILE
    record["verdict"]["reasons"][0].update(where=HOSTILE, what_to_do=HOSTILE)
    record["refinements"][0].update(use=HOSTILE, rounds=[HOSTILE])
    record["libraries"][HOSTILE] = HOSTILE
    found = page()
    check_self_contained(found)
    assert "<script>" not in found
    assert text_of(found).count('<script>alert("1")</script>') == 13


@pytest.fixture
def failed(record):
    return record | {"status": "failed", "panorama": None, "verdict": None, "motion": None, "levels": [], "warnings": []}


def untied(merged=None, reason="too dark"):
    """Make the error of six exposures: the first three are tied together, so are the next two, and one is alone."""
    groups = [Group(FrameSpan(100 * k, 100 * k + 100), 100 * k + 50) for k in range(6)]
    edges = [Edge(3, 2, NotLocated(reason)), Edge(5, 4, NotLocated(f"{reason} as well"))]
    message = (
        "level 2: 2 of 8 pairs could not be located\n  frames 300 to 399 onto frames 200 to 299: too dark\nTry larger groups."
    )
    return UntiedError(message, 2, groups, edges, np.array([0, 0, 0, 1, 1, 2]), 0.1, merged)


def test_page_of_a_failed_part_says_where_its_frames_begin(failed):
    assert "Frames count from" not in text_of(render_failure(failed, LocationError("too dark")))
    failed["spec"]["source"]["with"]["frames"] = [400, 600]
    assert "Frames count from frame 400 of the capture." in text_of(render_failure(failed, LocationError("too dark")))


def test_page_of_failed_run_shows_exposures_that_did_not_match(failed, record, exposure_of):
    page = render_failure(failed | {"levels": record["levels"][:1]}, untied(exposure_of))
    check_self_contained(page)
    text = text_of(page)
    for sentence in (
        "photonpano 0.1.0 failed corridor-pan",
        "The run failed: level 2: 2 of 8 pairs could not be located. Try larger groups. The run folder is as it was",
        "Exposures of one row are tied together",
        "Frames 300 to 399 against 200 to 299: too dark",
        "Frames 500 to 599 against 400 to 499: too dark as well",
    ):
        assert sentence in text
    assert "Motion" not in text
    assert page.count("data:image/jpeg") == 4 + 4  # of pairs, and of the ends of parts that can be tied by hand
    assert re.findall(r'"frame": (\d+)', page) == ["50", "250", "350", "450"]  # the instants that exposures are seen from
    [figure] = re.findall(r"<svg.*?</svg>", page, re.DOTALL)
    assert [name for name in ("part 1", "part 2", "part 3", "other parts", "alone") if f">{name}<" in figure] == [
        "part 1",
        "part 2",
        "alone",
    ]


def test_page_says_verdict_in_words(record, text):
    record["motion"] = {"std_px": 0.1234, "worst_std_px": 1.5, "worst_frame": 9874}
    expected = (
        "The motion is expected to err by 0.12 px at the corners of a frame, and by 1.5 px at worst (frame 9,874). "
        "250 frames of 10,000 were not located."
    )
    assert f"This panorama is doubtful: 1 thing speaks against it. {expected}" in text()
    trusted = {"status": "trusted", "reasons": [], "residual_ratio": 1.04}
    words = (
        "This panorama can be relied on: motion and panorama explain the photons, and short spans of frames scatter 1.04 times"
    )
    assert f"{words} as much as noise does. {expected}" in text(verdict=trusted)
    unknown = text(verdict=trusted | {"residual_ratio": None})
    assert "photonpano 0.1.0 done trusted corridor-pan" in unknown
    assert "Do not rely" not in unknown
    assert "scatter of short spans" not in unknown
    assert "Not tested" not in unknown
    note = {"what": "parts change", "figure": 0.08, "threshold": 0.03, "where": "x 3", "what_to_do": "mask"}
    assert "Found, but too small to make it wrong: Parts change (x 3) : 0.08" in text(verdict=trusted | {"notes": [note]})
    assert "Not tested: whether it moves (20 spans)" in text(verdict=trusted | {"untested": ["whether it moves (20 spans)"]})


def test_report_imports_no_library_before_it_draws_and_never_pyplot():
    code = (
        "import sys, photonpano.report; print(sorted(sys.modules)); "
        "from photonpano.report.drawing import plain_figure as drawn, svg_of\nwith drawn(1, 1) as figure: svg_of(figure, '')\n"
        "print(sorted(sys.modules))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    before, after = map(ast.literal_eval, result.stdout.splitlines())
    assert not {"jinja2", "matplotlib", "ruamel.yaml"} & set(before)
    assert "matplotlib.figure" in after
    assert "matplotlib.pyplot" not in after
