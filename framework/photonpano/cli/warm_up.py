"""photonpano warm-up."""

from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from pathlib import Path

    from photonpano.specs import Plan

_FRAMES, _GROUP = 240, 40


def warm_up() -> None:
    """Compile what runs need, for this machine.

    Otherwise the first run does it, and takes so much longer. It is kept beside the installed package, or in your home where
    that cannot be written, until the package or the machine changes.

    Example: photonpano warm-up
    """
    import tempfile
    import time
    from pathlib import Path

    from photonpano.pipeline.run import run
    from photonpano.specs import parse_spec

    start = time.perf_counter()
    source = {
        "use": "simulator",
        "with": {"n_frames": _FRAMES, "frame_shape": [96, 128], "path": {"kind": "pan", "length_px": 40}},
    }
    resample = {"with": {"group_size": _GROUP}}
    with tempfile.TemporaryDirectory() as folder:
        capture = Path(folder) / "capture.npy"
        _write(parse_spec({"version": 1, "source": source}), capture)
        spec = {
            "version": 1,
            "source": {"use": "packed-npy", "with": {"path": str(capture)}},
            "resample": resample,
            "levels": [{"scale": 0.5}, {}],
        }
        run(parse_spec(spec, output=Path(folder) / "run"))
    typer.echo(f"ready, after {time.perf_counter() - start:.0f} s")


def _write(plan: "Plan", capture: "Path") -> None:
    from photonpano.captures.writing import write_packed
    from photonpano.pipeline.components import build_source

    with build_source(plan) as source:
        write_packed(source, capture)
