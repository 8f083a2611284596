"""Damage small valid files at random, and read them: nothing but our own errors may be raised, and nothing may hang or crash.

    python tests/benchmarks/fuzz.py [--kinds ubicept tiff] [--seconds 60] [--seed 0]

Each kind of file is damaged for so many seconds: sources, masks, dark counts, specs, run folders and truths. Files that need
a library in C are read twice if something goes wrong: without a first look, to find them quickly, and then with it, as the
program reads them. The table counts files that were read, that were refused with a sentence, that only the first look has
refused, and failures, which are listed with their numbers: `--first 123` begins with that file again.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import select
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path

import numpy as np

from photonpano import FrameSpan, InputError, PhotonpanoError, SourceContext, discover, evaluate, load_spec, run
from photonpano.pipeline.components import build_source, open_source
from photonpano.registry import Catalog
from photonpano.specs import parse_spec

HANGS_S = 5.0
"""A file that takes longer is a failure; also one with a first look, which takes 2 s at most to find a loop."""
STARTS_S = 1800.0
"""A worker imports and compiles first, which takes long at a low priority."""
MEMORY_BYTES = 8 * 1024**3
MOST_READ = 2**26
"""Pixels of a damaged capture that are summed at most."""
FRAMES = np.random.default_rng(0).integers(0, 2, (64, 24, 32), dtype=np.uint8)
GREY = (np.random.default_rng(1).random((12, 48, 64)) * 255).astype(np.uint8)


def whole(name: str, folder: Path) -> Path:
    """Write a valid file or folder of a kind, and return what is read; all files in the folder may be damaged."""
    packed = np.packbits(FRAMES, axis=2)
    path = folder / "capture"
    match name:
        case "packed-npy":
            np.save(path := folder / "capture.npy", packed)
        case "npy":
            np.save(path := folder / "capture.npy", FRAMES)
        case "npy-gz":
            import gzip

            np.save(folder / "x.npy", packed)
            path = folder / "capture.npy.gz"
            path.write_bytes(gzip.compress((folder / "x.npy").read_bytes()))
            (folder / "x.npy").unlink()
        case "spad512-sparse":
            path = folder / "capture.bin"
            path.write_bytes(np.array([5, 17, 262144, 3, 9, 262144], "<u4").tobytes())
        case "mat5" | "mat5-compressed":
            from scipy.io import savemat

            content = {"TEXT": "text", "OUTPUT": np.moveaxis(FRAMES, 0, -1)}
            savemat(folder / "part_1.mat", content, do_compression=name != "mat5")
            path = folder
        case "mat73":
            import h5py

            with h5py.File(folder / "part_1.mat", "w") as file:
                file.create_dataset("OUTPUT", data=FRAMES.swapaxes(1, 2), chunks=(16, 32, 24), compression="gzip")
            path = folder
        case "ubicept":
            import h5py

            with h5py.File(path := folder / "capture.ubi.h5", "w") as file:
                for index, frame in enumerate(FRAMES[:12]):
                    file.create_dataset(f"raw/{index}", data=frame[..., None, None], chunks=(12, 32, 1, 1), compression="gzip")
                    file[f"raw/{index}"].attrs["metadata"] = '{"num_integrated_binary_frames": 3}'
        case "visionsim":
            np.save(folder / "frames.npy", packed)
            keys = {"h": 24, "w": 32, "c": 1, "fps": 9.5, "bitpack": True, "bitpack_dim": 2, "file_path": "frames.npy"}
            (folder / "transforms.json").write_text(json.dumps(keys | {"frames": [{}] * 64}))
            path = folder
        case "mraw-cih" | "mraw-cihx":
            data = Path(__file__).parents[1] / "data" / "photron"
            header = data / ("beam.cihx" if name == "mraw-cihx" else "sample_60k_16bit.cih")
            path = folder / f"a{header.suffix}"
            path.write_bytes(header.read_bytes())
            (folder / "a.mraw").write_bytes(bytes(7_913_472) if name == "mraw-cih" else (data / "beam.mraw").read_bytes())
        case "png":
            import cv2

            for index, frame in enumerate(GREY[:4]):
                cv2.imwrite(str(folder / f"{index}.png"), frame)
            path = folder
        case "tiff-folder":
            import tifffile

            for index, frame in enumerate(GREY[:4]):
                tifffile.imwrite(folder / f"{index}.tif", frame, compression=None if index % 2 else "zlib")
            path = folder
        case "tiff" | "tiff-zlib":
            import tifffile

            path = folder / "capture.tif"
            tifffile.imwrite(path, GREY, compression=None if name == "tiff" else "zlib", photometric="minisblack")
        case "avi" | "mkv" | "mp4":
            path = folder / f"capture.{name}"
            _film(path, {"avi": "mpeg4", "mkv": "ffv1", "mp4": "libx264"}[name])
        case "mask" | "mask-png" | "dark":
            np.save(folder / "capture.npy", packed)
            if name == "mask-png":
                import cv2

                cv2.imwrite(str(folder / "mask.png"), FRAMES[0] * 255)
            elif name == "mask":
                np.save(folder / "mask.npy", FRAMES[0].astype(bool))
            else:
                np.savez_compressed(folder / "dark.npz", rates=np.full((24, 32), 1e-3), n_frames=np.array(9))
        case "spec":
            np.save(folder / "capture.npy", packed)
            path = folder / "scan.yaml"
            path.write_text(SPEC)
        case "truth" | "run":
            _make_run(folder)
        case _:
            raise ValueError(name)
    return path


SPEC = """\
version: 1
source: &source {use: packed-npy, with: {path: capture.npy, frame_rate_hz: 96800}}
corrections: [rot90, {crop: {rows: [2, null]}}, still-pixels]
resample: {use: midpoint, with: {group_size: 4}}
locate: {use: chain-of-backends, with: {backends: [direct, {use: opencv-sift, with: {min_inliers: 12}}]}}
levels:
  - {scale: 0.5}
  - {locate: {use: direct}}
render: {scale: 2.0, reference: middle}
output: {directory: runs/scan}
run: {seed: 0, threads: auto, memory: 2 GiB}
"""
FIXED = {"mask": ("capture.npy",), "mask-png": ("capture.npy",), "dark": ("capture.npy",), "spec": ("capture.npy",)}
"""Files that are not damaged, since another kind does."""
SOURCES = {
    **{"mat5": "mat-parts", "mat5-compressed": "mat-parts", "mat73": "mat-parts", "ubicept": "ubicept-h5"},
    **{"packed-npy": "packed-npy", "npy": "npy", "npy-gz": "packed-npy", "spad512-sparse": "spad512-sparse"},
    **{"visionsim": "visionsim", "mraw-cih": "fastcam-mraw", "mraw-cihx": "fastcam-mraw"},
    **{"png": "image-folder", "tiff-folder": "image-folder", "tiff": "image-folder", "tiff-zlib": "image-folder"},
    **{"avi": "video", "mkv": "video", "mp4": "video"},
}
KINDS = [*SOURCES, "mask", "mask-png", "dark", "spec", "truth", "run"]
LOOKED_AT = {"mask-png", "mat73", "ubicept", "tiff-folder", "tiff", "tiff-zlib", "avi", "mkv", "mp4"}
"""Kinds that a process of its own looks at first."""
LOOKING = (
    "photonpano.corrections.masks",
    *(f"photonpano_sensors.{module}" for module in ("mat_parts", "ubicept", "intensity.pictures", "intensity.video_index")),
)
"""Modules that have it look."""


def _film(path: Path, codec: str) -> None:
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30)
        stream.height, stream.width, stream.pix_fmt = 48, 64, "gray" if codec == "ffv1" else "yuv420p"
        for frame in GREY:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, "gray").reformat(format=stream.pix_fmt)))
        container.mux(stream.encode())


def _make_run(folder: Path) -> None:
    from photonpano import simulate

    scene = {"kind": "street", "width": 300, "height": 200}
    source = {"scene": scene, "path": {"kind": "pan", "length_px": 20}, "flux": 1, "n_frames": 120, "frame_shape": [64, 96]}
    simulate(parse_spec({"version": 1, "source": {"use": "simulator", "with": source}}), folder / "cube.npy")
    keys = {"path": str(folder / "cube.npy")}
    spec = {"version": 1, "source": {"use": "packed-npy", "with": keys}, "levels": 1, "resample": {"with": {"group_size": 30}}}
    run(parse_spec(spec, output=folder / "run"))


def read(name: str, path: Path, folder: Path) -> None:
    """Read files of a kind as the program does.

    Raises:
        PhotonpanoError: they are refused.
    """
    if name in SOURCES:
        _read_source(SOURCES[name], path)
    elif name in ("mask", "mask-png", "dark"):
        file = {"mask": "mask.npy", "mask-png": "mask.png", "dark": "dark.npz"}[name]
        keys = {"dark-counts": {"dark": file}} if name == "dark" else {"mask": {"file": file}}
        source = {"use": "packed-npy", "with": {"path": "capture.npy"}}
        plan = parse_spec({"version": 1, "source": source, "corrections": [keys]}, directory=folder, catalog=_catalog())
        with build_source(plan):
            pass
    elif name == "spec":
        plan = load_spec(path, catalog=_catalog())
        with open_source(plan):
            pass
    else:
        evaluate(folder / "run", folder / "cube.truth.npz", oracle=False)
        from photonpano.record.run_json import read_record

        parse_spec(read_record(folder / "run")["spec"], catalog=_catalog())


@cache
def _catalog() -> Catalog:
    return discover()


def _read_source(use: str, path: Path) -> None:
    for entry in _catalog().rows:
        if entry.kind == "source":
            entry.contribution.recognise(path)
    contribution = _catalog().find("source", use).contribution
    config = contribution.config(path=path, **({"holds": "bits"} if use == "npy" else {}))
    if problems := list(contribution.check(config)):
        raise InputError(problems[0])
    with contribution.build(config, SourceContext()) as source:
        info = source.info
        assert min(info.n_frames, info.height, info.width) > 0
        most = max(1, MOST_READ // (info.height * info.width))
        source.frames(FrameSpan(0, 1))
        source.counts(FrameSpan(0, min(info.n_frames, most)))


def damaged(content: bytes, rng: random.Random) -> bytes:
    """Change some bytes, numbers, words or blocks."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        size = len(data)
        if not size:
            return bytes(data)
        # Headers are short and matter most.
        at = rng.randrange(min(size, rng.choice((64, 512, 4096, size))))
        many = rng.choice((1, 2, 4, 8, 64))
        match rng.randrange(8):
            case 0 | 1:
                data[at] = rng.randrange(256)
            case 2:
                data[at] ^= 1 << rng.randrange(8)
            case 3:
                data[at : at + many] = rng.choice((b"\0", b"\xff", b"\x7f", b"9")) * many
            case 4:
                number = rng.choice((0, 1, 2**31 - 1, 2**32 - 1, 2**16, rng.randrange(2**32)))
                data[at : at + 4] = number.to_bytes(4, rng.choice(("little", "big")))
            case 5:
                del data[at : at + many]
            case 6:
                data[at:at] = data[at : at + many]
            case 7:
                del data[rng.randrange(size) :]
    return bytes(data)


def cases(name: str, seed: int, looks: bool) -> Iterator[tuple[int, Callable[[], None]]]:
    """Yield numbered cases of a kind, endlessly; each damages one file of the same valid ones."""
    if not looks:
        for name_of_module in LOOKING:
            __import__(name_of_module)
            sys.modules[name_of_module].look_first = lambda *_: None
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        path = whole(name, folder)
        fixed = {folder / each for each in FIXED.get(name, ())}
        contents = {file: file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file() and file not in fixed}
        if name in ("truth", "run"):
            contents = {file: content for file, content in contents.items() if _is_of(name, file)}
        contents = {file: content for file, content in contents.items() if file.suffix != ".mraw"}
        with suppress(PhotonpanoError):
            read(name, path, folder)  # imports, and compiles
        number = 0
        while True:
            rng = random.Random(f"{name} {seed} {number}")
            victim = rng.choice(list(contents))
            victim.write_bytes(damaged(contents[victim], rng))
            yield number, lambda: read(name, path, folder)
            victim.write_bytes(contents[victim])
            for unpacked in folder.glob("*.unpacked.npy"):
                unpacked.unlink()
            number += 1


def _is_of(name: str, file: Path) -> bool:
    return file.name == "cube.truth.npz" if name == "truth" else file.parent.name == "run" and file.suffix != ".png"


def work(name: str, seed: int, first: int, only: bool, looks: bool) -> None:
    """Read damaged files, and print what became of each; the parent ends it."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    for number, case in cases(name, seed, looks):
        if number < first:
            continue
        print(f"begin {number}", flush=True)
        try:
            case()
            print(f"read {number}", flush=True)
        except PhotonpanoError as error:
            one_line = " ".join(str(error).split())
            print(f"refused {number} {one_line}" if one_line else f"failed {number} an error without a message", flush=True)
        except Exception as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            message = " ".join(f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})".split())
            print(f"failed {number} {message}", flush=True)
        if only:
            return


class Worker:
    """A process that reads damaged files of a kind."""

    def __init__(self, name: str, seed: int, first: int, *, looks: bool = False, only: bool = False) -> None:
        flags = [flag for flag, is_on in (("--looks", looks), ("--only-one", only)) if is_on]
        command = [sys.executable, __file__, "--work", name, "--seed", str(seed), "--first", str(first), *flags]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        self._lines: list[str] = []
        self._rest = b""

    def line(self, seconds: float) -> str | None:
        """Return the next line; "" if the process has ended, None if the time is over."""
        assert self._process.stdout is not None
        end = time.monotonic() + seconds
        while not self._lines:
            if not select.select([self._process.stdout], [], [], max(0.0, end - time.monotonic()))[0]:
                return None
            data = os.read(self._process.stdout.fileno(), 65536)
            if not data:
                return ""
            *lines, self._rest = (self._rest + data).split(b"\n")
            self._lines += [line.decode(errors="replace") for line in lines]
        return self._lines.pop(0)

    def end(self) -> int:
        """Kill the process, and return its exit code."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(0.5)
        self._process.kill()
        return self._process.wait()


def outcome(worker: Worker, seconds: float) -> tuple[str, str]:
    """Return what became of a case that a worker has begun."""
    line = worker.line(seconds)
    if line is None:
        worker.end()
        return "failed", f"takes longer than {seconds:g} s"
    if not line:
        return "failed", f"the process ended with {worker.end()}"
    word, _, rest = line.partition(" ")
    return word, rest.partition(" ")[2]


def again_with_look(name: str, seed: int, number: int) -> tuple[str, str]:
    """Read a file that was a failure once more, with a first look."""
    worker = Worker(name, seed, number, looks=True, only=True)
    if not worker.line(120):
        return "failed", f"the worker ended with {worker.end()}"
    word, text = outcome(worker, HANGS_S + 10)
    worker.end()
    return ("looked" if word == "refused" else word), text


def fuzz(name: str, seed: int, seconds: float) -> tuple[Counter[str], dict[str, list[int]]]:
    """Damage files of a kind for some time; return counts, and the numbers of failures by their messages."""
    counts: Counter[str] = Counter()
    failures: dict[str, list[int]] = {}
    first, end = 0, float("inf")
    worker = Worker(name, seed, first)
    try:
        while time.monotonic() < end:
            begun = worker.line(STARTS_S)
            end = min(end, time.monotonic() + seconds)  # without the imports of the first file
            if not begun:
                raise RuntimeError(f"{name}: the worker ended with {worker.end()}")
            first = int(begun.split()[1]) + 1
            word, text = outcome(worker, HANGS_S)
            dead = text.startswith(("takes longer", "the process ended"))
            if dead or (word == "failed" and name in LOOKED_AT):  # another process may have taken the time
                word, text = again_with_look(name, seed, first - 1)
            if dead:
                worker = Worker(name, seed, first)
            counts[word] += 1
            if word == "failed":
                failures.setdefault(text, []).append(first - 1)
    finally:
        worker.end()
    return counts, failures


def main() -> None:
    """Fuzz the kinds, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--kinds", nargs="*", default=KINDS, choices=KINDS)
    parser.add_argument("--seconds", type=float, default=60, help="seconds for each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--work", help=argparse.SUPPRESS)
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument("--looks", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--only-one", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work:
        work(options.work, options.seed, options.first, options.only_one, options.looks)
        return
    print("| kind | read | refused | by the first look | failures |\n| --- | --- | --- | --- | --- |", flush=True)
    total: Counter[str] = Counter()
    for name in options.kinds:
        counts, failures = fuzz(name, options.seed, options.seconds)
        total += counts
        print(
            "|", " | ".join([name, *(str(counts[word]) for word in ("read", "refused", "looked", "failed"))]), "|", flush=True
        )
        for message, numbers in failures.items():
            print(f"  {len(numbers)} of {name}, such as {numbers[:5]}: {message}", file=sys.stderr, flush=True)
    _print_row("all", total)


def _print_row(name: str, counts: Counter[str]) -> None:
    print("|", " | ".join([name, *(str(counts[word]) for word in ("read", "refused", "looked", "failed"))]), "|", flush=True)


if __name__ == "__main__":
    main()
