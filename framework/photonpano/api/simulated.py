"""Simulated captures: write one, try the program on one, and compile the loops over pixels by a run on one."""

from __future__ import annotations

import shutil
import tempfile
import time
import webbrowser
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import typer

from photonpano.api.command import command, warn
from photonpano.api.copies import WrittenCapture, lines_of_capture, require_new_capture, write_capture, writer_of
from photonpano.api.judging import evaluate
from photonpano.api.run import lines_of_run
from photonpano.capture.writing import truth_path
from photonpano.evaluation import Evaluation
from photonpano.execution.context import Progress, usual
from photonpano.execution.threads import one_thread_inside, thread_count
from photonpano.files.folders import atomic_folder, require_new
from photonpano.pipeline.components import build_source
from photonpano.pipeline.run import RunResult, run
from photonpano.plugins.registry import discover
from photonpano.record.picture_files import advancing, write_pngs
from photonpano.report.preview import require_sharp_views, sharp_pictures
from photonpano.specs import Plan, load_spec, parse_spec
from photonpano.text import columns

_SPECS = Path(__file__).parent / "demo_specs"


@command(
    "capture.yaml --output cube.npy",
    lines_of_capture,
    plan="spec",
    output=typer.Option("--output", "-o", metavar="CUBE.npy"),
    sharp_every=typer.Option(min=1, metavar="N"),
)
def simulate(
    plan: Plan,
    output: Path | str,
    progress: Progress | None = None,
    sharp_every: int | None = None,
    *,
    overwrite: bool = False,
) -> WrittenCapture:
    """Write a capture as `convert` does, whole or not at all; a simulated one with its truth beside it.

    The truth (motion and scene) is for `evaluate`. The spec needs only `version` and `source`. A recording has no truth, and no
    frames without noise.

    Args:
        plan: of the capture; its source may be any that gives binary frames.
        output: the .npy file, or the folder.
        progress: receives the stage; by default, bars in a notebook and nothing elsewhere.
        sharp_every: write each frame of this distance without noise as well, to the folder CAPTURE.sharp, such as
            cube.sharp/frame_000050.png for cube.npy: 8 bits, sRGB, the same white in all. By default, none.
        overwrite: replace the files that are there under these names.

    Raises:
        InputError: as `convert`; or the source cannot show frames without noise.
        OutputError: as `convert`, also for the folder of the pictures.
    """
    output = Path(output)
    writer = writer_of(output, discover())
    with build_source(plan) as source:
        require_new_capture(source, plan, output, overwrite)
        if sharp_every is None:
            return write_capture(source, plan, output, progress=progress, resumed=None, writer=writer)
        sharp, views = output.with_suffix(".sharp"), require_sharp_views(source)
        require_new(sharp, overwrite)
        frames = range(0, source.info.n_frames, sharp_every)
        with atomic_folder(sharp) as folder:
            with one_thread_inside(), usual(progress).stage(f"writing {sharp.name}", len(frames), "pictures") as advance:
                pictures = sharp_pictures(views, frames, thread_count(plan.run.threads))
                write_pngs(folder, advancing(pictures, advance), [f"frame_{frame:06}" for frame in frames])
            return replace(write_capture(source, plan, output, progress=progress, resumed=None, writer=writer), sharp=sharp)


def _lines(made: tuple[RunResult, Evaluation], *, open_report: bool = False) -> Iterator[str]:
    result, score = made
    yield from lines_of_run(result)
    yield columns(score.rows())
    report = (result.directory / "report.html").resolve()
    if open_report and not webbrowser.open(report.as_uri()):
        warn(f"no browser could be started; open {report} in one")


@command(
    "demo --open",
    _lines,
    directory=typer.Argument(metavar="DIR"),
    open_report=typer.Option("--open", help="Open the report in the browser."),
)
def demo(
    directory: Path | str, *, small: bool = False, overwrite: bool = False, progress: Progress | None = None
) -> tuple[RunResult, Evaluation]:
    """Simulate a small capture, make its panorama, and score it against the truth.

    Takes a minute or two. The folder holds the specs of the capture and of its run, capture.yaml and scan.yaml, to change and
    to run again; the capture; and the run folder `run`, with panorama.png and report.html.

    Args:
        directory: the folder to write, in one that is there.
        small: simulate fewer and smaller frames, whose panorama takes seconds.
        overwrite: replace what an earlier demo has written there; other files stay.
        progress: receives the stages; by default, bars in a notebook and nothing elsewhere.

    Returns:
        The run, and its score.

    Raises:
        OutputError: the folder cannot be written, or holds files and is not to be overwritten.
    """
    directory = Path(directory)
    require_new(directory, overwrite)
    with atomic_folder(directory) as folder:
        shutil.copyfile(_SPECS / ("small-capture.yaml" if small else "capture.yaml"), folder / "capture.yaml")
        shutil.copyfile(_SPECS / "scan.yaml", folder / "scan.yaml")
    capture = directory / "capture.npy"
    simulate(load_spec(directory / "capture.yaml"), capture, progress, overwrite=overwrite)
    result = run(load_spec(directory / "scan.yaml"), progress, overwrite=overwrite)
    return result, evaluate(result.directory, truth_path(capture), progress=progress)


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
