"""Make the pictures of the README and of the docs from simulated captures, and from a real one.

    python docs/make_pictures.py

Simulates captures into a folder, `runs/pictures` by default, runs them in several ways, writes the PNG files of docs/images,
and prints the scores that the docs mention. Existing captures and runs are used again.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from pictures import high_speed, mandrill, room, scan, scenes, street, super_resolution, tremor

if TYPE_CHECKING:
    from picture_parts import Picture

IMAGES = Path(__file__).parent / "images"
PICTURES = street, scan, tremor, scenes, room, mandrill, super_resolution, high_speed
"""Modules, each of which makes some of the pictures."""


def main() -> None:
    """Make all pictures."""
    parser = argparse.ArgumentParser(description="Make the pictures of the docs.")
    parser.add_argument("folder", nargs="?", type=Path, default=Path("runs/pictures"), help="for the captures and the runs")
    folder: Path = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    for module in PICTURES:
        for name, image in module.pictures(folder):
            save(name, image)


def save(name: str, image: Picture) -> None:
    """Write a PNG of 64 grey levels, which halves the file without a visible difference."""
    quantised = np.where(image == 255, 255, image & 0xFC).astype(np.uint8)
    cv2.imwrite(str(IMAGES / name), quantised, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(f"{IMAGES / name}: {(IMAGES / name).stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
