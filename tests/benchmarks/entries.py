"""Enter photonpano and other programs in the benchmark: the table of docs/how-to/benchmark.md.

    python tests/benchmarks/entries.py docs/how-to/benchmark.md [--quantaodometry FOLDER] [--quantaodometry-python PYTHON]
        [--folder runs/entries] [--only flat dark] [--limit-s 900]

The captures are those that `python -m tests.benchmarks.open make` writes, the public half. Programs run as in peers.py; one
whose code is not given has no column. Entries stay in the folder, one for each program, so that an interrupted benchmark
continues.
"""

from __future__ import annotations

import platform
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from harness import chosen, command, table, write_tables
from open.captures import PUBLIC, Benchmark, BenchmarkCapture, make
from open.score import CaptureScore, score
from peers import Peer, result_of

from photonpano import parse_spec, run
from photonpano.text import pixels, share

GROUPS = {"dark": 150, "fast": 17, "loop": 33, "trembling": 50, "turn": 35}
USUAL_GROUP = 75
"""Frames in a group of the programs that need to be told: those in which the scene moves by about 10 px."""
PEERS = {
    "OpenCV's Stitcher": Peer("stitcher"),
    "COLMAP's SIFT": Peer("colmap"),
    "quantaodometry, mended": Peer("quantaodometry", mended=True),
}


def spec_of(name: str, capture: BenchmarkCapture, path: Path) -> dict[str, Any]:
    """Return the spec of photonpano: all defaults, and what is known of the filters and of a camera that turns."""
    source = {"use": "packed-npy", "with": {"path": str(path.resolve()), "frame_rate_hz": capture.frame_rate_hz}}
    spec: dict[str, Any] = {"version": 1, "source": source}
    if capture.filters is not None:
        spec["corrections"] = [{"colour-filter": {"pattern": capture.filters, "keep": "all"}}]
    if name in ("lens", "turn"):
        camera = {"focal_px": capture.focal_px} | ({"distortion": {"k1": "find"}} if name == "lens" else {})
        spec |= {"motion": {"model": "rotation"}, "camera": camera}
    return spec


def enter(peer: Peer, captures: Path, entry: Path, code: Path | None, python: Path | None, limit_s: float) -> dict[str, str]:
    """Let a program run on all captures, write its entry, and return why it has none for some of them."""
    entry.mkdir(parents=True, exist_ok=True)
    stops, seconds = {}, {}
    for name in Benchmark.read(captures).captures:
        found = result_of(peer, captures / f"{name}.npy", GROUPS.get(name, USUAL_GROUP), code, python, limit_s)
        if isinstance(found, str):
            stops[name] = found
            continue
        with np.load(found) as result:
            seconds[name] = float(result["cpu_s"])
            if "homographies" in result:
                np.savez(entry / f"{name}.npz", homographies=result["homographies"])
    (entry / "seconds.csv").write_text("".join(f"{name},{value:.1f}\n" for name, value in seconds.items()))
    return stops


def cells(scored: CaptureScore, stops: dict[str, str]) -> Iterator[str]:
    """Yield what the table says of a capture of another program."""
    if scored.capture in stops:
        yield "stops"
    elif scored.error_px is None:
        yield "none"
    else:
        lost = "" if scored.located_share is None or scored.located_share > 0.9995 else f", {share(scored.located_share)}"
        yield f"{pixels(scored.error_px)} px{lost}"


def main(
    page: Path | None,
    quantaodometry: Path | None = None,
    quantaodometry_python: Path | None = None,
    folder: Path = Path("runs/entries"),
    only: Sequence[str] = (),
    limit_s: float = 900.0,
) -> None:
    """Make the captures, let all programs run on them, and write the table."""
    captures = folder / "captures"
    names = chosen(only, PUBLIC)
    if not captures.exists():
        make(captures, names)
    ours = folder / "photonpano"
    for name, capture in Benchmark.read(captures).captures.items():
        if not (ours / name / "run.json").exists():
            run(parse_spec(spec_of(name, capture, captures / capture.file), output=ours / name))
    columns: dict[str, list[str]] = {}
    for row, peer in PEERS.items():
        if peer.program == "quantaodometry" and quantaodometry is None:
            continue
        code = quantaodometry.resolve() if quantaodometry is not None and peer.program == "quantaodometry" else None
        entry = folder / peer.slug
        stops = enter(peer, captures, entry, code, quantaodometry_python if code else None, limit_s)
        scores = score(captures, entry)
        columns[row] = [text for each in scores for text in cells(each, stops)]
    rows = []
    for each, *others in zip(score(captures, ours), *columns.values(), strict=True):
        motion = f"{pixels(each.error_px)} px", share(each.honest_share)
        rows.append([each.capture, *motion, f"{each.psnr_db:.1f} dB", f"{each.seconds:.0f} s", *others])
    head = ["Capture", "photonpano", "in 3 std", "PSNR", "wall time", *columns]
    made = f"{datetime.now(UTC):%Y-%m-%d}, {platform.machine()}, two cores, which had other work beside."
    write_tables(page, {"entries": [*table(head, rows), "", made]})
    print("\n".join(table(head, rows)))


if __name__ == "__main__":
    command(main, "entries")
