"""The captures of the open benchmark: the conditions, what is drawn of each from a seed, and how a set is written."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Mapping, Sequence
from copy import deepcopy
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict

from photonpano import __version__
from photonpano.api.simulated import simulate
from photonpano.errors import InputError, SpecError
from photonpano.execution.context import Progress, Quiet, usual
from photonpano.files.folders import atomic_folder, require_new
from photonpano.pipeline.components import build_source
from photonpano.reading import read_json, reading
from photonpano.specs import Plan, parse_spec

VERSION: Literal[1] = 1  # of the set; raised whenever a capture changes
DESCRIPTION = "benchmark.json"
SEALED = "sealed-"  # prefix of the captures whose truth is not published
_PUBLIC_SEED = b"photonpano benchmark 1"
# Below these, seeds are drawn: nobody can try all of those of a sealed capture.
_PUBLIC_SEEDS, _SEALED_SEEDS = 2**31, 2**63 - 1
_SHORTEST_SECRET = 16  # bytes, which nobody guesses
_DRAWS = 20  # paths that are tried for a capture, since some leave the scene
_SHAKE = {"rms_px": 2, "roll_rms_deg": 0.05, "frequencies_hz": [60, 170, 400]}

# What each condition changes of `_USUAL`, and in which halves of the set it is.
_USUAL: Mapping[str, Any] = {
    "scene": {"kind": "street"},
    "path": {"kind": "random-spline", "length_px": 400},
    "flux": 0.5,
    "n_frames": 3000,
    "frame_shape": [128, 192],
    "frame_rate_hz": 96800,
    "focal_length_px": 800,
}
_CONDITIONS: Mapping[str, tuple[Mapping[str, Any], bool, bool]] = {
    "flat": ({}, True, True),
    "dark": ({"flux": 0.02, "n_frames": 6000}, True, True),
    "fast": ({"path": {"kind": "random-spline", "length_px": 1200}, "n_frames": 2000}, True, True),
    "loop": ({"path": {"kind": "loop", "length_px": 900}}, True, False),
    "trembling": ({"path": {"kind": "random-spline", "length_px": 200, "shake": _SHAKE}}, True, True),
    "lens": ({"distortion": {"k1": -0.2, "k2": 0.03}, "focal_length_px": 260}, True, True),
    "people": ({"people": {"share": 0.2}}, True, True),
    "near": ({"clutter": {"share": 0.15}, "path": {**_USUAL["path"], "travel_m": [0.4, 0.1, 0]}}, True, True),
    "turn": (
        {
            "scene": {"kind": "street", "width": 1024, "height": 512},
            "path": {"kind": "turn", "degrees": 400, "pitch_wobble_deg": 3, "roll_wobble_deg": 2},
            "frame_shape": [96, 160],
            "focal_length_px": 163,
            "n_frames": 4000,
        },
        True,
        False,
    ),
    "colour": ({"sensor": {"filters": "rggb"}, "flux": 1}, True, False),
    "flicker": ({"lamps": [{"frequency_hz": 120, "depth": 0.6}]}, False, True),
    "super-resolution": (
        {"scene_scale": 2, "path": {"kind": "random-spline", "length_px": 120}, "n_frames": 4000},
        False,
        True,
    ),
    "high-dynamic-range": (
        {"scene": {"kind": "night"}, "path": {"kind": "random-spline", "length_px": 150}, "n_frames": 6000},
        False,
        True,
    ),
}
PUBLIC = tuple(name for name, (_, public, _) in _CONDITIONS.items() if public)
ALL = (*PUBLIC, *(SEALED + name for name, (_, _, sealed) in _CONDITIONS.items() if sealed))


class BenchmarkCapture(BaseModel):
    """What an entry may know of a capture."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    file: str  # packed frames, beside the description
    n_frames: int
    frame_shape: tuple[int, int]  # rows and columns, in px
    frame_rate_hz: float
    focal_px: float
    filters: str | None  # the array of colour filters; None for a grey sensor
    sha256: str  # of the file


class _Version(BaseModel):
    version: int
    photonpano: str


class Benchmark(BaseModel):
    """A set of captures that was written: the content of `benchmark.json`."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    version: int
    photonpano: str  # the version that made it
    captures: Mapping[str, BenchmarkCapture]

    @classmethod
    def read(cls, folder: Path) -> Benchmark:
        """Read the description of a set; raises an `InputError` if it is none, or of another version."""
        path = folder / DESCRIPTION
        if not path.exists():
            raise InputError(f"{folder} has no {DESCRIPTION}; give the folder that `make` wrote")
        found = read_json(path, _Version)
        if found.version != VERSION:
            raise InputError(
                f"{path} describes version {found.version} of the benchmark, made by photonpano {found.photonpano}, and this "
                f"photonpano scores version {VERSION}: make the set again, or install that version"
            )
        return read_json(path, cls)


def capture_plan(name: str, secret: bytes | None = None) -> Plan:
    """Return the plan of a capture, drawn from the public seed, or from the secret if it is a sealed one.

    Paths that leave the scene are drawn again.
    """
    seed, seeds = (secret, _SEALED_SEEDS) if name.startswith(SEALED) else (_PUBLIC_SEED, _PUBLIC_SEEDS)
    assert seed is not None
    changes, *_ = _CONDITIONS[name.removeprefix(SEALED)]
    rng = np.random.default_rng(np.frombuffer(hashlib.sha256(seed + name.encode()).digest(), np.uint32))
    problem: SpecError | None = None
    for _ in range(_DRAWS):
        settings = deepcopy({**_USUAL, **changes})
        drawn = {key: int(rng.integers(seeds)) for key in ("scene", "path", "people", "clutter")}
        for key in drawn.keys() & settings.keys():
            settings[key]["seed"] = drawn[key]
        if "seed" in (path := settings["path"]) and path["kind"] != "random-spline":
            del path["seed"]
            path |= {"loop": {"aspect": rng.uniform(1, 2)}, "turn": {"wobbles": rng.uniform(3, 7)}}[path["kind"]]
        settings["seed"] = int(rng.integers(seeds))
        try:
            plan = parse_spec({"version": 1, "source": {"use": "simulator", "with": settings}})
            with build_source(plan, look=False):
                return plan
        except SpecError as error:
            problem = error
    assert problem is not None
    raise problem


def described_capture(file: Path, plan: Plan) -> BenchmarkCapture:
    """Describe a capture that was written."""
    settings = plan.document["source"]["with"]
    with file.open("rb") as content:
        digest = hashlib.file_digest(content, "sha256").hexdigest()
    return BenchmarkCapture(
        file=file.name,
        n_frames=settings["n_frames"],
        frame_shape=settings["frame_shape"],
        frame_rate_hz=settings["frame_rate_hz"],
        focal_px=settings["focal_length_px"],
        filters=settings["sensor"]["filters"],
        sha256=digest,
    )


def make(
    folder: Path | str,
    captures: Sequence[str] = (),
    secret: Path | str | None = None,
    truths: Path | str | None = None,
    *,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> Benchmark:
    """Write the captures of the benchmark with their truth, and benchmark.json, which describes them.

    The sealed captures come with a release. Who keeps their secret makes them with it; their truth goes to another folder.

    Args:
        folder: of the set.
        captures: names of the captures to write; by default all that can be.
        secret: a file of 16 bytes or more, from which the sealed captures are drawn.
        truths: the folder for the truth of the sealed captures.
        overwrite: replace the captures that are there under these names.
        progress: receives the stages; by default, bars in a notebook and nothing elsewhere.

    Raises:
        InputError: there is no such capture, or the secret is missing or too short.
        OutputError: the folder, or a truth of a sealed capture, is there already, or cannot be written.
    """
    folder = Path(folder)
    chosen = captures or (PUBLIC if secret is None else ALL)
    if unknown := sorted(set(chosen) - set(ALL)):
        raise InputError(f"there is no capture {' or '.join(unknown)}; choose from {', '.join(ALL)}")
    sealed = [name for name in chosen if name.startswith(SEALED)]
    if sealed and (secret is None or truths is None):
        raise InputError(
            f"{', '.join(sealed)}: sealed captures come with a release; to make them, give their --secret, and a folder for "
            "their --truths"
        )
    seed = None if secret is None else _secret(Path(secret))
    require_new(folder, overwrite)
    sealed_truths = {name: Path(truths, f"{name}.truth.npz") for name in sealed} if truths is not None else {}
    for path in sealed_truths.values():
        require_new(path, overwrite)
    described = {}
    with atomic_folder(folder) as written, usual(progress).stage("benchmark", len(chosen), "captures") as advance:
        for name in chosen:
            plan = capture_plan(name, seed)
            made = simulate(plan, written / f"{name}.npy", Quiet())
            if name in sealed_truths:
                assert made.truth is not None
                sealed_truths[name].parent.mkdir(parents=True, exist_ok=True)
                shutil.move(made.truth, sealed_truths[name])
            described[name] = described_capture(made.path, plan)
            advance(1)
        benchmark = Benchmark(version=VERSION, photonpano=__version__, captures=described)
        (written / DESCRIPTION).write_text(benchmark.model_dump_json(indent=2) + "\n", encoding="utf-8")
    return benchmark


def _secret(path: Path) -> bytes:
    with reading(path):
        secret = path.read_bytes().strip()
    if len(secret) < _SHORTEST_SECRET:
        raise InputError(
            f"{path} holds {len(secret)} bytes, which can be guessed; give a secret of {_SHORTEST_SECRET} bytes or more"
        )
    return secret
