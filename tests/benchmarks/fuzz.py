"""Damage small valid files at random, and read them: nothing but our own errors may be raised.

    python tests/benchmarks/fuzz.py [--kinds ubicept tiff] [--seconds 60] [--seed 0]

Each kind of file is damaged for so many seconds: sources, masks, dark counts, specs, run folders and truths. The table counts
files that were read, that were refused with a sentence, and failures, which are listed with their numbers: `--first 123`
begins with that file again. A process that hangs or ends is a failure, too, but nothing is promised against it where a library
in C reads the file.
"""

from __future__ import annotations

import os
import random
import resource
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path

from fuzz_files import FIXED, KINDS, read, whole
from harness import command, passing, table

from photonpano import PhotonpanoError

HANGS_S = 5.0  # a file that takes longer is a failure
STARTS_S = 1800.0  # a worker imports and compiles first, which takes long at a low priority
MEMORY_BYTES = 8 * 1024**3
OUTCOMES = ("read", "refused", "failed")


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


def cases(name: str, seed: int) -> Iterator[tuple[int, Callable[[], None]]]:
    """Yield numbered cases of a kind, endlessly; each damages one file of the same valid ones."""
    with passing() as study:
        folder = study.folder
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


def work(pipe: Connection, name: str, seed: int, first: int) -> None:
    """Read damaged files, and tell what became of each: its number, a word and a message; the parent ends it."""
    silent = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(silent, stream)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    for number, case in cases(name, seed):
        if number < first:
            continue
        pipe.send((number, "begins", ""))
        try:
            case()
            word, text = "read", ""
        except PhotonpanoError as error:
            word, text = ("refused", "") if str(error).strip() else ("failed", "an error without a message")
        except Exception as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            word, text = "failed", f"{type(error).__name__}: {error} ({Path(where.filename).name}:{where.lineno})"
        pipe.send((number, word, " ".join(text.split())))


class Worker:
    """A process that reads damaged files of a kind."""

    def __init__(self, name: str, seed: int, first: int) -> None:
        context = get_context("spawn")
        self._pipe, told = context.Pipe(duplex=False)
        self._process = context.Process(target=work, args=(told, name, seed, first), daemon=True)
        self._process.start()
        told.close()

    def said(self, seconds: float) -> tuple[int, str, str]:
        """Return what it tells next; or that it is dead, after which it is so if it was not."""
        text = "the process ended"
        with suppress(EOFError, OSError):
            if self._pipe.poll(seconds):
                return self._pipe.recv()
            text = f"takes longer than {seconds:g} s"
        return -1, "dead", f"{text}: {self.end()}"

    def end(self) -> int | None:
        """Kill the process, and return its exit code."""
        self._process.join(0.5)
        self._process.kill()
        self._process.join()
        return self._process.exitcode


def fuzz(name: str, seed: int, seconds: float, first: int = 0) -> tuple[Counter[str], dict[str, list[int]]]:
    """Damage files of a kind for some time; return counts, and the numbers of failures by their messages."""
    counts: Counter[str] = Counter()
    failures: dict[str, list[int]] = {}
    end, worker = float("inf"), Worker(name, seed, first)
    try:
        while time.monotonic() < end:
            number, word, text = worker.said(STARTS_S)
            end = min(end, time.monotonic() + seconds)  # without the imports of the first file
            if word == "dead":
                raise RuntimeError(f"{name}: {text}")
            _, word, text = worker.said(HANGS_S)
            if word == "dead":
                word, worker = "failed", Worker(name, seed, number + 1)
            counts[word] += 1
            if word == "failed":
                failures.setdefault(text, []).append(number)
    finally:
        worker.end()
    return counts, failures


def rows(kinds: Sequence[str], seed: int, seconds: float, first: int) -> Iterator[Sequence[object]]:
    """Fuzz the kinds: yield the rows of the table, and list the failures."""
    total: Counter[str] = Counter()
    for name in kinds:
        counts, failures = fuzz(name, seed, seconds, first)
        total += counts
        yield name, *(counts[word] for word in OUTCOMES)
        for message, numbers in failures.items():
            print(f"  {len(numbers)} of {name}, such as {numbers[:5]}: {message}", file=sys.stderr, flush=True)
    yield "all", *(total[word] for word in OUTCOMES)


def main(kinds: Sequence[str] = tuple(KINDS), seconds: float = 60.0, seed: int = 0, first: int = 0) -> None:
    """Fuzz the kinds, each for so many seconds, and print a table."""
    if wrong := {*kinds} - {*KINDS}:
        raise SystemExit(f"no kind is called {', '.join(wrong)}; there are {', '.join(KINDS)}")
    table(("kind", "read", "refused", "failures"), rows(kinds, seed, seconds, first))


if __name__ == "__main__":
    command(main)
