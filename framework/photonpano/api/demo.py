"""Simulate a small capture, make its panorama, and score it."""

from __future__ import annotations

import shutil
import webbrowser
from collections.abc import Iterator
from pathlib import Path

import typer

from photonpano.api.command import command, warn
from photonpano.api.evaluate import evaluate
from photonpano.api.run import lines_of_run
from photonpano.api.simulate import simulate
from photonpano.capture.writing import truth_path
from photonpano.evaluation import Evaluation
from photonpano.execution.context import Progress
from photonpano.files.folders import atomic_folder, require_new
from photonpano.pipeline.run import RunResult, run
from photonpano.specs import load_spec
from photonpano.text import columns

_SPECS = Path(__file__).parent / "demo_specs"


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
