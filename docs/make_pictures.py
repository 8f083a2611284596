"""Make the pictures of the README and of the docs from simulated captures, and from a real one.

    python docs/make_pictures.py

Simulates captures into a folder, `runs/pictures` by default, runs them in several ways, writes the PNG files of docs/images,
and prints the scores that the docs mention. Existing captures and runs are used again; `--only` takes words of the names of
pictures, and makes those of the same captures.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "tests" / "benchmarks"))
from harness import IMAGES, Study, chosen, command
from picture_parts import encoded
from pictures import gallery, instant, movers, scan, scenes, street, tremor

PICTURES = {
    "readme levels interpolation": street.pictures,
    "first-panorama uncertainty baselines hot-pixels": scan.pictures,
    "tremor video": tremor.pictures,
    "what-moves action-shot": movers.pictures,
    "real-world": movers.real_world,
    "one-instant": instant.pictures,
    "night depth": scenes.pictures,
    "room": scenes.room,
    "mandrill": scan.mandrill,
    "usaf usaf-contrast": gallery.usaf,
    "nebula": gallery.nebula,
    "super-resolution": scenes.super_resolution,
    "high-speed": scenes.high_speed,
}
"""Functions, each of which yields some of the pictures with their names."""


def main(folder: Path = Path("runs/pictures"), only: Sequence[str] = ()) -> None:
    """Make all pictures."""
    folder.mkdir(parents=True, exist_ok=True)
    for names in chosen(only, PICTURES):
        for name, image in PICTURES[names](Study(folder)):
            path = IMAGES / name
            path.write_bytes(encoded(image, 64))
            print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    command(main)
