"""The figures of the paper: the page quotes its numbers, each has a spec and a picture, and the smallest are made anew."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import ModuleType

import cv2
import pytest

import photonpano_baselines
from photonpano import load_spec

ROOT = Path(__file__).parents[2]
PAPER, SPECS = ROOT / "docs" / "paper", ROOT / "examples" / "paper"
NUMBERS = json.loads((PAPER / "numbers.json").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def make_paper() -> ModuleType:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "docs")
        import make_paper

        yield make_paper


def test_page_quotes_the_numbers(make_paper):
    page = (PAPER / "README.md").read_text(encoding="utf-8")
    assert make_paper.filled(page, NUMBERS) == page, "run: make paper"


def test_every_figure_has_numbers_and_pictures_are_small(make_paper):
    assert list(NUMBERS) == list(make_paper.FIGURES)
    pictures = {path.stem: path.stat().st_size for path in (PAPER / "images").iterdir()}
    assert pictures.keys() <= NUMBERS.keys()
    assert max(pictures.values()) < make_paper.MOST_BYTES


def test_claims_of_failures_do_not_agree_where_nothing_fails(make_paper):
    """The paper's camera in the dark, its flicker and its noise do harm only where the numbers show it."""
    numbers = json.loads(json.dumps(NUMBERS))
    dark = numbers["fig4-light"]
    dark["read_noise"] = {"5": {method: [dark["n_frames"]] * len(dark["photons"]) for method in ("stitcher", "chain")}}
    numbers["fig9"]["apertures"]["f/5.6"]["single"] = numbers["fig9"]["apertures"]["f/2.8"]["direct"]
    numbers["fig10"]["steady"] = numbers["fig10"]["steady"][:1] * len(numbers["fig10"]["depths"])
    claims = {name: make_paper.FIGURES[name].claims(numbers[name]) for name in ("fig4-light", "fig9", "fig10")}
    assert all("never fails" in claim.measured and not claim.agrees for claim in claims["fig4-light"])
    assert [claim.agrees for claim in claims["fig9"] if "f/5.6" in claim.paper] == [False, None]
    assert [claim.agrees for claim in claims["fig10"]] == [False, None, None, False]


@pytest.mark.parametrize("spec", sorted(SPECS.glob("*.yaml")), ids=lambda path: path.stem)
def test_specs_are_valid_and_linked(spec):
    load_spec(spec, catalog=photonpano_baselines.catalog())
    for page in (PAPER / "README.md", SPECS / "README.md"):
        assert f"{spec.name})" in page.read_text(encoding="utf-8")


@pytest.mark.documentation
def test_quick_figures_show_what_the_paper_says(make_paper, tmp_path, without_report):
    """Levels refine the motion, and a constant number of groups does not; the page is filled with the numbers of the run."""
    study = make_paper.Study(tmp_path, quick=True)
    make_paper.make(study, ["fig3", "fig5", "s2"], tmp_path)
    numbers = json.loads((tmp_path / "numbers.json").read_text())
    assert numbers["fig5"]["n_frames"] < NUMBERS["fig5"]["n_frames"]
    for name in numbers:
        claims = make_paper.FIGURES[name].claims(numbers[name])
        assert [claim.paper for claim in claims if not claim.agrees] == []
        image = cv2.imread(str(tmp_path / "images" / f"{name}.png"))
        assert min(image.shape[:2]) > 100
    page = (tmp_path / "README.md").read_text()
    assert f"mean corner error {numbers['fig5']['constant']['mean_px']:g} px" in page
    assert re.search(r"fig5: begin -->\nEach capture has 400 frames at 100,000 Hz\.\n\n\| The paper", page)
