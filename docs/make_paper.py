"""Make the figures of "Panoramas from Photons", and the tables that compare the paper's statements with what they measure.

    python docs/make_paper.py [--quick] [--only fig4 fig5] [--folder runs/paper]

Simulates captures, runs them, writes docs/paper/images and docs/paper/numbers.json, and fills the tables of
docs/paper/README.md from these numbers. Captures and runs of the same specs are used again: remove the folder to measure anew.
A quick study has small captures, and leaves its pictures, numbers and page in the folder.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parents[1] / "tests" / "benchmarks"))
from harness import Study, chosen, command
from harness import filled as with_table
from paper.figures import FIGURES
from picture_parts import save

PAPER = Path(__file__).parent / "paper"
MOST_BYTES = 400_000


def main(quick: bool = False, only: Sequence[str] = (), folder: Path = Path("runs/paper")) -> None:
    """Make the figures."""
    study = Study(folder / ("quick" if quick else "full"), quick)
    study.folder.mkdir(parents=True, exist_ok=True)
    make(study, chosen(only, FIGURES), study.folder if quick else PAPER)


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
            save(image, into / "images" / f"{name}.png", MOST_BYTES)
        ordered = {each: numbers[each] for each in FIGURES if each in numbers}
        file.write_text(json.dumps(ordered, indent=2) + "\n", encoding="utf-8")
        print(f"{name}: {time.monotonic() - began:.0f} s", flush=True)
    page = into / "README.md"
    page.write_text(filled(page.read_text(encoding="utf-8"), numbers), encoding="utf-8")


def filled(page: str, numbers: dict[str, Any]) -> str:
    """Return a page with the captures and the tables of the figures whose numbers are known."""
    for name, of_figure in numbers.items():
        taken = "Each capture has {n_frames:,} frames at {frame_rate_hz:,} Hz."
        captured = [taken.format(**of_figure), ""] if "n_frames" in of_figure else []
        rows = [claim.row() for claim in FIGURES[name].claims(of_figure)]
        page = with_table(page, name, [*captured, "| The paper | Measured here | Agrees |", "| --- | --- | --- |", *rows])
    return page


if __name__ == "__main__":
    command(main)
