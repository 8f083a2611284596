"""Make the figures of "Panoramas from Photons", and the tables that compare the paper's statements with what they measure.

    python docs/make_paper.py [--quick] [--only fig4 fig5] [--folder runs/paper]

Simulates captures, runs them, writes docs/paper/images and docs/paper/numbers.json, and fills the tables of
docs/paper/README.md from these numbers. Captures and runs of the same specs are used again: remove the folder to measure anew.
A quick study has small captures, and leaves its pictures, numbers and page in the folder.
"""

from __future__ import annotations

import argparse
import json
import shutil
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from paper.figures import FIGURES
from paper.figures.study import Study

if TYPE_CHECKING:
    from picture_parts import Picture

PAPER = Path(__file__).parent / "paper"
MOST_BYTES = 400_000
WHITE = 250
"""Brighter levels become white, as is the page."""


def main() -> None:
    """Make the figures."""
    parser = argparse.ArgumentParser(description="Make the figures of the paper.")
    parser.add_argument("--quick", action="store_true", help="small captures, into the folder instead of docs/paper")
    parser.add_argument("--only", nargs="+", choices=FIGURES, default=list(FIGURES), metavar="FIGURE", help=", ".join(FIGURES))
    parser.add_argument("--folder", type=Path, default=Path("runs/paper"), help="for captures, runs and a quick study")
    arguments = parser.parse_args()
    study = Study(arguments.folder / ("quick" if arguments.quick else "full"), arguments.quick)
    study.folder.mkdir(parents=True, exist_ok=True)
    make(study, arguments.only, study.folder if arguments.quick else PAPER)


def make(study: Study, names: list[str], into: Path) -> None:
    """Make figures, and write pictures, numbers and the page into a folder."""
    (into / "images").mkdir(exist_ok=True)
    if into != PAPER:
        shutil.copy(PAPER / "README.md", into)
    file = into / "numbers.json"
    numbers: dict[str, Any] = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    for name in names:
        began = time.monotonic()
        image, numbers[name] = FIGURES[name].make(study)
        if image is not None:
            save(image, into / "images" / f"{name}.png")
        ordered = {each: numbers[each] for each in FIGURES if each in numbers}
        file.write_text(json.dumps(ordered, indent=2) + "\n", encoding="utf-8")
        print(f"{name}: {time.monotonic() - began:.0f} s", flush=True)
    page = into / "README.md"
    page.write_text(filled(page.read_text(encoding="utf-8"), numbers), encoding="utf-8")


def filled(page: str, numbers: dict[str, Any]) -> str:
    """Return a page with the captures and the tables of the figures whose numbers are known."""
    for name in numbers:
        begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
        before, rest = page.split(begin)
        rows = [claim.row() for claim in FIGURES[name].claims(numbers[name])]
        taken = captured(numbers[name])
        table = "\n".join([begin, *taken, "| The paper | Measured here | Agrees |", "| --- | --- | --- |", *rows, end])
        page = before + table + rest.split(end)[1]
    return page


def captured(numbers: dict[str, Any]) -> list[str]:
    """Return the lines that say how many frames the captures of a figure have; none where there is no capture."""
    if "n_frames" not in numbers:
        return []
    return [f"Each capture has {numbers['n_frames']:,} frames at {numbers['frame_rate_hz']:,} Hz.", ""]


def save(image: Picture, path: Path) -> None:
    """Write a PNG, grey or BGR, of 32 levels and few enough pixels."""
    while True:
        coarse = np.where(image > WHITE, 255, image & 0xF8).astype(np.uint8)
        encoded = cv2.imencode(".png", coarse, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()
        if len(encoded) < MOST_BYTES:
            break
        image = cv2.resize(image, None, fx=0.9, fy=0.9, interpolation=cv2.INTER_AREA).astype(np.uint8)
    path.write_bytes(encoded)


if __name__ == "__main__":
    main()
