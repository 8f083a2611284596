"""Compile the loops over pixels for this machine."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from photonpano.api.command import command
from photonpano.api.simulate import simulate
from photonpano.pipeline.run import run
from photonpano.specs import parse_spec


@command("", lambda seconds: [f"ready after {seconds:.0f} s"])
def warm_up() -> float:
    """Compile the loops over pixels for this machine, by a run on a small simulated capture.

    Otherwise the first run compiles them. The result is kept beside the installed package, or in the home folder where that
    cannot be written, until the package or the machine changes.

    Returns:
        How long it took, in seconds.
    """
    start = time.perf_counter()
    simulator = {"n_frames": 240, "frame_shape": [96, 128], "path": {"kind": "pan", "length_px": 40}}
    with tempfile.TemporaryDirectory() as folder:
        capture = Path(folder) / "capture.npy"
        simulate(parse_spec({"version": 1, "source": {"use": "simulator", "with": simulator}}), capture)
        spec = {
            "version": 1,
            "source": {"use": "packed-npy", "with": {"path": str(capture)}},
            "resample": {"with": {"group_size": 40}},
            "levels": [{"scale": 0.5}, {}],
        }
        run(parse_spec(spec, output=Path(folder) / "run"))
    return time.perf_counter() - start
