"""What tests/benchmarks/peers.py says of other programs, which themselves are not here: the page, scores, and a stand-in."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

from photonpano.evaluation import Truth
from photonpano.geometry import translation
from photonpano.testing.captures import textured

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs" / "explanation" / "peers.md"
SHAPE = (60, 90)


@pytest.fixture(scope="module")
def peers() -> ModuleType:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "tests" / "benchmarks")
        return importlib.import_module("peers")


def test_page_quotes_the_numbers(peers):
    text = page = PAGE.read_text(encoding="utf-8")
    for name, lines in peers.tables_of(json.loads(PAGE.with_suffix(".json").read_text(encoding="utf-8"))).items():
        text = sys.modules[peers.table.__module__].filled(text, name, lines)
    assert text == page, "run: python tests/benchmarks/peers.py docs/explanation/peers.md, and the code of the programs"


def test_best_of_a_capture_has_all_of_it_and_peers_that_are_better_are_named(peers):
    half = {"mean_px": 0.1, "located": 0.5, "cpu_s": 1.0, "mib": 9.0}
    found = {peer: {"why": "not given"} for peer in peers.PEERS} | {
        "photonpano": half | {"mean_px": 0.3, "located": 1.0, "cpu_s": 2.0},
        "cQBPy": half,
        "COLMAP's SIFT": half | {"mean_px": 0.2, "located": 1.0},
        "spano": {"why": "a singular matrix"},
    }
    tables = peers.tables_of({"date": "today", "machine": "here", "results": {"flat": found}})
    cells = dict(line.strip("| ").split(" | ") for line in tables["motion"] if line.count("|") == 3 and line[2:3].strip())
    assert cells["COLMAP's SIFT"] == "**0.20 px**"
    assert cells["cQBPy"] == "0.10 px, 50 % of the frames"
    assert (cells["spano"], cells["quantaodometry"]) == ("stops", "not given")
    assert tables["motion"][-1] == "Better than photonpano: COLMAP's SIFT (flat)."
    assert tables["time"][-1] == "Better than photonpano: cQBPy (flat), COLMAP's SIFT (flat)."
    assert tables["stops"] == ["- spano: `a singular matrix` (flat)"]


def test_picture_of_a_stand_in_is_placed_and_scored(peers, tmp_path):
    scene = np.asarray(textured((200, 300), 0.3), np.float32)
    motion = np.stack([translation(0.5 * frame, 30) for frame in range(200)])
    truth = Truth(motion, SHAPE, scene, motion)
    part = scene[30:90, 20:170] / peers.white_flux(scene)
    cv2.imwrite(str(tmp_path / "made.png"), np.rint(255 * np.clip(part, 0, 1) ** (1 / 2.2)))
    stand_in = tmp_path / "spano"
    stand_in.write_text(f"#!{sys.executable}\nimport shutil, sys\nshutil.copy('{tmp_path}/made.png', sys.argv[5])\n")
    stand_in.chmod(0o755)
    np.save(tmp_path / "flat-0.npy", np.zeros((16, 60, 12), np.uint8))
    result = peers.result_of(peers.PEERS["spano"], tmp_path / "flat-0.npy", 8, stand_in, None, 60)
    with np.load(result) as found:
        scores = peers.scores(found, truth)
    assert scores["psnr_db"] > 30
    assert scores["shown"] == pytest.approx(150 / 190, abs=0.06)  # of the width that the frames see
    assert "mean_px" not in scores


def test_program_that_stops_says_why(peers, tmp_path):
    np.save(tmp_path / "flat-0.npy", np.zeros((16, 60, 12), np.uint8))
    why = peers.result_of(peers.PEERS["COLMAP's SIFT"], tmp_path / "flat-0.npy", 8, None, None, 60)
    assert why == "RuntimeError: no pair of averages is registered"
