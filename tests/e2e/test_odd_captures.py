"""Odd captures, masks and dark counts: each ends in seconds, with results or with one sentence that names the right part."""

from __future__ import annotations

import gzip
import re
import struct
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import typer

from photonpano.api.cli.errors import reported
from photonpano.geometry import translation
from photonpano.pipeline.run import run
from photonpano.plugins.registry import Catalog, discover
from photonpano.specs import parse_spec
from photonpano.testing import KnownMotion, Scene
from photonpano.testing.captures import recorded

N_FRAMES, HEIGHT, WIDTH = 160, 48, 64
LONGEST = 5  # processor time of a run, in runs of the good capture
MAGIC = b"\x93NUMPY\x01\x00"
NUMBER = re.compile(r"(?<![A-Za-z])\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?")


@dataclass(frozen=True)
class Case:
    """An odd file.

    Attributes:
        write: writes it, given its path and the frames (160, 48, 64) of a good capture.
        file: its name.
        keys: of the source.
        correction: reads the file in place of the source, which reads a good capture.
    """

    write: Callable[[Path, np.ndarray], Any]
    file: str = "cube.npy"
    keys: Mapping[str, Any] = field(default_factory=dict)
    correction: Mapping[str, Any] | None = None


def packed(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path, np.ndarray], None]:
    """Return what writes changed frames as a packed capture."""
    return lambda path, frames: np.save(path, np.packbits(change(frames.copy()), axis=-1))


def array(make: Callable[[np.ndarray], Any]) -> Callable[[Path, np.ndarray], None]:
    """Return what writes an array of the packed frames."""
    return lambda path, frames: np.save(path, make(np.packbits(frames, axis=-1)))


def content(change: Callable[[bytes], bytes]) -> Callable[[Path, np.ndarray], int]:
    """Return what writes the changed bytes of a good file."""

    def write(path: Path, frames: np.ndarray) -> int:
        whole = BytesIO()
        np.save(whole, np.packbits(frames, axis=-1))
        return path.write_bytes(change(whole.getvalue()))

    return write


def header(text: str) -> Callable[[Path, np.ndarray], int]:
    """Return what writes a .npy file with another header."""
    words = text.encode("latin-1")
    return content(lambda data: MAGIC + struct.pack("<H", len(words)) + words + data[128:])


def with_shape(shape: str) -> Callable[[Path, np.ndarray], int]:
    return header(f"{{'descr': '|u1', 'fortran_order': False, 'shape': {shape}, }}\n")


def part(span: slice, value: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return what sets some of the frames to a value."""

    def change(frames: np.ndarray) -> np.ndarray:
        frames[span] = value
        return frames

    return change


def pixels(where: tuple[Any, ...], value: int) -> Callable[[np.ndarray], np.ndarray]:
    """Return what sets some pixels of all frames to a value."""

    def change(frames: np.ndarray) -> np.ndarray:
        frames[(slice(None), *where)] = value
        return frames

    return change


def halves(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    """Return what changes the second half of the frames."""
    return lambda frames: np.concatenate([frames[:80], change(frames[80:])])


def lit(probability: float) -> Callable[[np.ndarray], np.ndarray]:
    return lambda frames: np.random.default_rng(0).random(frames.shape) < probability


ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH]
SCENES: Mapping[str, Callable[[np.ndarray], np.ndarray]] = {
    "one frame": lambda frames: frames[:1],
    "one row": lambda frames: frames[:, :1],
    "eight by eight": lambda frames: frames[:, :8, :8],
    "frozen": lambda frames: np.repeat(frames[:1], N_FRAMES, axis=0),
    "shuffled": lambda frames: np.random.default_rng(0).permutation(frames),
    "every second frame black": part(slice(None, None, 2), 0),
    "second half black": part(slice(80, None), 0),
    "all black": part(slice(None), 0),
    "all white": part(slice(None), 1),
    "one pixel lit once": lambda frames: part(slice(50, 51), 1)(0 * frames) * ((ROWS == 3) & (COLUMNS == 5)),
    "upside down in the middle": halves(lambda frames: frames[:, ::-1]),
    "jump of half a frame": halves(lambda frames: np.roll(frames, 32, axis=2)),
    "left half dead": pixels((slice(None), slice(32)), 0),
    "checkerboard": lambda frames: lit(0.5)(frames) & ((ROWS + COLUMNS) % 2 == 0),
    "noise": lit(0.3),
    "nearly black": lit(1e-4),
}
FILES: Mapping[str, Case] = {
    "header cut": Case(content(lambda data: data[:60])),
    "a spec": Case(content(lambda _: b"version: 1\nsource: {use: auto, with: {path: cube.npy}}\n")),
    "version 9": Case(content(lambda data: data[:6] + b"\x09" + data[7:])),
    "header of code": Case(header("__import__('os').abort()\n")),
    "header of a list": Case(header("[1, 2, 3]\n")),
    "shape of floats": Case(with_shape("(160.0, 48, 8)")),
    "shape of too many frames": Case(with_shape("(10**18, 48, 8)")),
    "no rows": Case(array(lambda frames: frames[:, :0])),
    "int8": Case(array(lambda frames: frames.astype(np.int8))),
    "records": Case(array(lambda frames: np.zeros(frames.shape, "u1,f4"))),
    "gzip twice": Case(content(lambda data: gzip.compress(gzip.compress(data, 1), 1)), file="cube.npy.gz"),
    "a link to nowhere": Case(lambda path, _: path.symlink_to("nowhere.npy")),
    "width of 61": Case(packed(lambda frames: frames[:, :, :61]), keys={"width": 61}),
    "lowest bit first": Case(packed(lambda frames: frames), keys={"bit_order": "little"}),
    "rate without end": Case(packed(lambda frames: frames), keys={"frame_rate_hz": 1e308}),
    "name of no UTF-8": Case(packed(lambda frames: frames), file="caf\udce9.npy"),
}


def mask(write: Callable[[Path, np.ndarray], Any], file: str = "bad.npy") -> Case:
    return Case(write, file, correction={"mask": {"file": file}})


def saved(values: Any) -> Callable[[Path, np.ndarray], None]:
    return lambda path, _: np.save(path, values, allow_pickle=True)


def picture(levels: np.ndarray, change: Callable[[bytes], bytes] = bytes) -> Callable[[Path, np.ndarray], int]:
    return lambda path, _: path.write_bytes(change(cv2.imencode(".png", levels)[1].tobytes()))


def bits(rows: slice = slice(0), columns: slice = slice(None)) -> np.ndarray:
    """Return a mask (48, 64) that is true in some rows and columns."""
    found = np.zeros((HEIGHT, WIDTH), bool)
    found[rows, columns] = True
    return found


GREY = 255 * bits(slice(3)).astype(np.uint8)
MASKS: Mapping[str, Case] = {
    "mask of everything": mask(saved(bits(slice(None)))),
    "mask of all but one": mask(saved(~bits(slice(3, 4), slice(5, 6)))),
    "mask of another size": mask(saved(bits()[1:])),
    "mask that promises too much": mask(header("{'descr': '|b1', 'fortran_order': False, 'shape': (10**7, 10**7), }\n")),
    "mask that is cut": mask(lambda path, _: path.write_bytes(MAGIC + b"v\0{'descr': '|b1'")),
    "mask that is missing": mask(lambda *_: None),
    "picture": mask(picture(GREY), "bad.png"),
    "picture of other size": mask(picture(GREY[1:]), "bad.png"),
    "picture that is cut": mask(picture(GREY, lambda data: data[:60]), "bad.png"),
    "picture of 60,000 px": mask(
        picture(GREY, lambda data: data[:16] + struct.pack(">II", 60_000, 60_000) + data[24:]), "bad.png"
    ),
}


def dark(**arrays: Any) -> Case:
    file = "dark.npz"
    return Case(lambda path, _: np.savez(path, **arrays), file, correction={"dark-counts": {"dark": file}})


RATES = np.full((HEIGHT, WIDTH), 1e-3, np.float32)
DARKS: Mapping[str, Case] = {
    "dark counts": dark(rates=RATES, n_frames=1000),
    "dark counts of one": dark(rates=RATES + 1, n_frames=1000),
    "dark counts without end": dark(rates=RATES * np.inf, n_frames=1000),
    "dark counts of another size": dark(rates=RATES[1:], n_frames=1000),
    "dark counts of half frames": dark(rates=RATES, n_frames=0.5),
}
CASES = {**{name: Case(packed(change)) for name, change in SCENES.items()}, **FILES, **MASKS, **DARKS}
OUTCOMES = Path(__file__).with_suffix(".txt")
"""What becomes of each: `NAME -> EXIT CODE FIRST LINE`; # is a number that the machine may change, DIR the folder."""


@pytest.fixture(scope="module")
def good() -> np.ndarray:
    """(160, 48, 64) frames of a pan of 24 px."""
    return recorded(Scene(), KnownMotion(lambda frame: translation(0.15 * frame, 0.05 * frame)), N_FRAMES, (HEIGHT, WIDTH))


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    return discover()


def spec_of(case: Case, folder: Path) -> dict[str, Any]:
    """Return a spec with one level, which reads the odd file."""
    file = "cube.npy" if case.correction else case.file
    return {
        "version": 1,
        "source": {"use": "packed-npy", "with": {"path": str(folder / file), **case.keys}},
        "corrections": [dict(case.correction)] if case.correction else [],
        "resample": {"use": "midpoint", "with": {"group_size": 20}},
        "levels": 1,
        "refine": [],
    }


def outcome(case: Case, folder: Path, catalog: Catalog) -> int:
    """Run as the command line does; return the exit code."""
    try:
        with reported():
            run(parse_spec(spec_of(case, folder), directory=folder, output=folder / "run", catalog=catalog))
    except typer.Exit as ended:
        return ended.exit_code
    return 0


@pytest.fixture(scope="module")
def good_s(good: np.ndarray, catalog: Catalog, tmp_path_factory: pytest.TempPathFactory) -> float:
    """Processor time that a run of the good capture takes, once everything is imported."""
    case, folder = (
        Case(lambda path, frames: np.save(path, np.packbits(frames, axis=-1)), "cube.npy"),
        tmp_path_factory.mktemp("good"),
    )
    case.write(folder / case.file, good)
    for name in ("first", "second"):
        (folder / name).mkdir()
        start = time.process_time()
        run(parse_spec(spec_of(case, folder), directory=folder, output=folder / name / "run", catalog=catalog))
    return time.process_time() - start


def expected() -> dict[str, str]:
    lines = OUTCOMES.read_text(encoding="utf-8").splitlines()
    return dict(line.split(" -> ", 1) for line in lines)


def test_every_case_has_an_outcome() -> None:
    assert list(expected()) == list(CASES)


@pytest.mark.usefixtures("without_report")
@pytest.mark.parametrize("name", CASES)
def test_odd_file_ends_in_results_or_one_sentence(
    name: str, good: np.ndarray, good_s: float, catalog: Catalog, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    case = CASES[name]
    if case.correction:
        np.save(tmp_path / "cube.npy", np.packbits(good, axis=-1))
    case.write(tmp_path / case.file, good)
    before = sorted(tmp_path.iterdir())
    start = time.process_time()
    code = outcome(case, tmp_path, catalog)
    assert time.process_time() - start < LONGEST * good_s
    printed = capsys.readouterr().err.replace(str(tmp_path), "DIR")
    first, *_ = [*(line for line in printed.splitlines() if not line.startswith("warning: ")), ""]
    assert "Traceback" not in printed
    assert f"{code} {first if code == 2 else NUMBER.sub('#', first)}".strip() == expected()[name]
    # Halves that differ too much are shots, each with a run folder.
    written = set(tmp_path.iterdir()) - {*before, tmp_path / "run.panorama-2"}
    assert written == ({tmp_path / "run.failed.html"} if "report    " in printed else set() if code else {tmp_path / "run"})
