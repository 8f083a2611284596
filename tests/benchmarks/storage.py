"""How long captures take that lie in zarr arrays and on servers, compared with a packed .npy file on the disk.

python tests/benchmarks/storage.py [--frames 100000] [--runs] [--folder FOLDER]

It makes a capture of 254x496 px at a flux of 0.1, copies it to zarr arrays, and serves all of them over HTTP on this machine,
as an object store does: see file_server.py. Each is read whole, in groups of 500 frames by as many threads as there are cores;
in spans of 16 frames, one after the other; and, with --runs, by whole runs of a smaller capture of a street. The best of three
readings counts, and the files are in the memory of the system.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
from harness import Cost, command, least, passing, simulator, took

from photonpano import FrameSpan, Source, capture_plan, convert, parse_spec, run, simulate
from photonpano.pipeline.components import build_source

SHAPE = 254, 496
FLUX = 0.1
GROUP, SHORT, SHORT_FRAMES = 500, 16, 4000
THREADS = len(os.sched_getaffinity(0))


def write_frames(path: Path, n_frames: int) -> None:
    """Write packed frames of a smooth scene, with the noise of photons."""
    rng = np.random.default_rng(0)
    rows, columns = np.indices(SHAPE)
    scene = 1 + 0.9 * np.sin(rows / 9) * np.sin(columns / 13)
    lit = ((1 - np.exp(-FLUX * scene / scene.mean())) * 65536).astype(np.uint16)
    cube = np.lib.format.open_memmap(path, "w+", np.uint8, (n_frames, SHAPE[0], SHAPE[1] // 8))
    for start in range(0, n_frames, GROUP):
        n = min(GROUP, n_frames - start)
        noise = np.frombuffer(rng.bytes(2 * n * scene.size), np.uint16).reshape(n, *SHAPE)
        cube[start : start + n] = np.packbits(noise < lit, axis=-1)
    cube.flush()


def read_groups(source: Source) -> None:
    """Sum the frames of each group, in all threads."""
    with ThreadPoolExecutor(THREADS) as pool:
        for _ in pool.map(source.counts, source.info.span.blocks(GROUP)):
            pass


def read_short_spans(source: Source) -> None:
    """Sum short spans, one after the other, as mergers do while the image moves."""
    for span in FrameSpan(0, min(SHORT_FRAMES, source.info.n_frames)).blocks(SHORT):
        source.counts(span)


def reading(path: str | Path, read: Callable[[Source], None]) -> Cost:
    """Return the shortest time of reading a capture, which is opened anew each time."""

    def read_anew() -> None:
        with build_source(capture_plan(path, corrections=[])) as source:
            read(source)

    return least(read_anew)


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder in a process of its own, and yield its address."""
    script = Path(__file__).parents[1] / "file_server.py"
    with subprocess.Popen([sys.executable, str(script), str(folder)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().strip()
        finally:
            process.kill()


def bytes_in(path: Path) -> int:
    return sum(file.stat().st_size for file in (path.iterdir() if path.is_dir() else [path]))


def compare(places: dict[str, str | Path], measure: Callable[[str | Path], Cost]) -> None:
    """Print the time of each place, its ratio to the first, and the processor time."""
    first = None
    for name, place in places.items():
        _, elapsed, processor, _ = measure(place)
        first = elapsed if first is None else first
        print(f"  {name:28} {elapsed:8.2f} s  x {elapsed / first:.2f}  {processor:8.2f} s of the processor", flush=True)


def all_places(cube: Path, address: str) -> dict[str, str | Path]:
    """Write a capture to zarr arrays, print their sizes, and return where all of them can be read."""
    arrays = {"zarr": cube.with_suffix(".zarr"), "zarr, zstd": cube.with_name(f"{cube.stem}-zstd.zarr")}
    for name, array in arrays.items():
        written = took(partial(convert, compress="zstd" in name), capture_plan(cube, corrections=[]), array)
        share = bytes_in(array) / bytes_in(cube)
        print(f"{name}: written in {written.seconds:.2f} s, {share:.3f} of the size of the .npy file", flush=True)
    names = {"npy": cube, **arrays}
    remote = {f"{name} over HTTP": f"{address}/bucket/{path.name}" for name, path in names.items()}
    remote |= {f"{name} in S3": f"s3://bucket/{path.name}" for name, path in names.items()}
    return {**names, **remote}


def whole_runs(folder: Path, address: str) -> None:
    """Compare whole runs of 10,000 frames of a street."""
    street = simulator(n_frames=10_000, frame_shape=[254, 496], flux=FLUX, path={"kind": "pan", "length_px": 400})
    capture = folder / "street.npy"
    simulate(parse_spec(street), capture)
    print("whole runs of 10,000 frames")

    def whole_run(place: str | Path) -> Cost:
        with passing() as study:
            spec = {"version": 1, "source": {"use": "auto", "with": {"path": str(place)}}}
            return took(run, parse_spec(spec, output=study.folder / "run"))

    whole_run(capture)  # compiles the loops over pixels
    compare(all_places(capture, address), whole_run)


def main(frames: int = 100_000, runs: bool = False, folder: Path | None = None) -> None:
    """Print the times of each way of reading; and of whole runs."""
    with passing(folder) as study, served(study.folder) as address:
        os.environ |= {"AWS_ENDPOINT_URL": address, "FSSPEC_S3_ANON": "true"}
        bucket = study.folder / "bucket"
        bucket.mkdir()
        cube = bucket / "cube.npy"
        write_frames(cube, frames)
        places = all_places(cube, address)
        print(f"{frames:,} frames in groups of {GROUP}, {THREADS} threads")
        compare(places, partial(reading, read=read_groups))
        print(f"{min(SHORT_FRAMES, frames):,} frames in spans of {SHORT}, one after the other")
        compare(places, partial(reading, read=read_short_spans))
        if runs:
            whole_runs(bucket, address)


if __name__ == "__main__":
    command(main)
