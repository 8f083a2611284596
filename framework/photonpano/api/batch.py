"""Run one spec on many captures, and write one summary."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import typer

from photonpano.api.batch_jobs import (
    CAPTURE_KEY,
    Job,
    SpecText,
    capture_override,
    combinations,
    find_captures,
    folder_name,
    is_of_capture,
    override,
    read_changes,
)
from photonpano.api.batch_running import PAGE, require_own, rows_of, write_summary
from photonpano.api.command import SPEC, DoubtfulError, WrongArgumentError, command
from photonpano.errors import InputError, OutputError, PhotonpanoError, Problem, SpecError
from photonpano.execution.context import Progress, usual
from photonpano.execution.threads import thread_count
from photonpano.files.folders import locked
from photonpano.files.paths import Location
from photonpano.notebooks import facts, from_here, table
from photonpano.plugins.registry import discover
from photonpano.record.batch_row import BatchRow, ranked
from photonpano.specs.loading import read_spec
from photonpano.text import columns, counted, pixels

_NO_FILE = "this source reads no file or folder, as the captures of a batch are; name another, such as auto"


@dataclass(frozen=True, slots=True)
class BatchResult:
    """A batch whose runs have ended.

    Attributes:
        directory: the folder of the batch, with a run folder for each capture, `summary.csv` and `summary.html`.
        rows: a `BatchRow` for each run: captures in their order, the runs of each ranked as in the summary.
        keys: the swept keys of the spec.
    """

    directory: Path
    rows: tuple[BatchRow, ...]
    keys: tuple[str, ...]

    @property
    def failed(self) -> tuple[BatchRow, ...]:
        """The rows of runs that failed."""
        return tuple(row for row in self.rows if row.status == "failed")

    def _repr_html_(self) -> str:
        """Show the runs, and where their summary is, in a notebook."""
        runs = table(BatchRow.COLUMNS, (row.cells() for row in self.rows))
        return runs + facts([("summary", str(from_here(self.directory) / PAGE))])


@dataclass(frozen=True, slots=True)
class Batch:
    """A batch that can begin: its captures are found, and its spec and settings are right. `rows` are the runs to do."""

    directory: Path
    spec: SpecText
    common: tuple[str, ...]
    keys: tuple[str, ...]
    rows: tuple[BatchRow, ...]


def batch(
    spec: str | Path | Mapping[str, Any],
    captures: Sequence[str | Path],
    output: str | Path,
    *,
    changes: Sequence[str] = (),
    sweep: Mapping[str, Sequence[Any]] | None = None,
    jobs: int = 1,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> BatchResult:
    """Run a spec on many captures, each in a process of its own, and write one summary of all.

    A run that fails, crashes or is killed becomes a row that says why, and the others go on. What was finished before, of the
    same spec, capture and versions, is not run again.

    Args:
        spec: a spec file, or a spec as plain data whose relative paths count from the current folder. Each capture takes the
            place of its `source.with.path`.
        captures: files, folders, URLs, and patterns such as `captures/*.npy`.
        output: the folder of the batch. The run folder of `night.npy` is `night` in it.
        changes: values to change in all runs, such as `run.seed=1`. A list sweeps a key that takes no list.
        sweep: values of keys, such as `{"resample.with.group_size": [50, 100]}`; every combination is run on every capture.
        jobs: how many runs go on at once; they share the cores.
        overwrite: write beside other files, which stay, or replace a run of another capture.
        progress: receives a note for each run that ends; by default, bars in a notebook and nothing elsewhere.

    Raises:
        SpecError: the spec, a change or a swept key is wrong; carries all problems. Nothing was run.
        InputError: there is no capture, two have one name, or `jobs` is less than 1. Nothing was run.
        OutputError: the folder of the batch cannot be written.
    """
    swept = [override(key, list(values)) for key, values in (sweep or {}).items()]
    return run_batch(prepare_batch(spec, captures, output, changes=changes, swept=swept), jobs, progress, overwrite=overwrite)


def prepare_batch(
    spec: str | Path | Mapping[str, Any],
    captures: Sequence[str | Path],
    output: str | Path,
    *,
    lists: Sequence[str | Path] = (),
    changes: Sequence[str] = (),
    swept: Sequence[str] = (),
) -> Batch:
    """Find the captures of a batch, and check its spec with all settings; arguments as in `batch`.

    `lists` are text files with one capture a line, `swept` keys with their values, such as `resample.with.group_size=50,100`.

    Raises:
        SpecError: the spec or a setting is wrong; carries all problems.
        InputError: the captures are wrong; the message has all problems, a line each.
    """
    catalog, directory = discover(), Path(output).absolute()
    if isinstance(spec, Mapping):
        text = SpecText(dict(spec), Path.cwd())
    else:
        file = Path(spec)
        text = SpecText(read_spec(file), file.parent.absolute(), file)

    def problems_of(capture: Location, *overrides: str) -> tuple[Problem, ...]:
        try:
            text.plan([*overrides, capture_override(capture)], directory, catalog)
        except SpecError as error:
            return error.problems
        return ()

    def is_capture(place: Location) -> bool:
        return not any(is_of_capture(each.where) for each in problems_of(place))

    found = find_captures(captures, lists, catalog, is_capture)
    sample = next((each for each in found.values() if is_capture(each)), next(iter(found.values())))

    def takes_list(key: str, change: str) -> bool:
        return not any(each.where == key and each.override == change for each in problems_of(sample, change))

    common, values = read_changes(changes, swept, takes_list)
    settings = combinations(values)
    _require_right(lambda overrides: problems_of(sample, *overrides), common, settings)
    rows = tuple(
        BatchRow(name, capture, setting, directory / folder_name(name, setting))
        for name, capture in found.items()
        for setting in settings
    )
    return Batch(directory, text, tuple(common), tuple(values), rows)


def run_batch(batch: Batch, jobs: int = 1, progress: Progress | None = None, *, overwrite: bool = False) -> BatchResult:
    """Run a batch that was prepared: see `batch`."""
    if jobs < 1:
        raise InputError(f"jobs: expected at least 1, got {jobs}")
    directory, rows, n_ended, progress = batch.directory, list(batch.rows), 0, usual(progress)
    n_workers = min(jobs, len(rows))
    threads = max(1, thread_count("auto") // n_workers)
    todo = []
    for row in rows:  # the capture is the last override, as a setting may name another source
        settings = [override(key, value) for key, value in row.settings.items()]
        overrides = (*batch.common, *settings, capture_override(row.capture))
        todo.append(Job(row, batch.spec, overrides, threads, overwrite))
    _make(directory)

    def write() -> None:
        write_summary(directory, rows, batch.spec.content, batch.common, batch.keys)

    with locked(directory / "batch", f"the batch {directory}"):
        if not overwrite:
            require_own(directory)
        write()  # proves that the folder can be written to
        try:
            with progress.stage("batch", len(rows), "runs") as advance, closing(rows_of(todo, n_workers)) as changes:
                for changed in changes:
                    for index, row in changed:
                        rows[index] = row
                        if row.status != "running":
                            n_ended += 1
                            progress.note(f"[{n_ended}/{len(rows)}] {_line(row)}")
                            advance(1)
                    write()
        except BaseException:
            rows[:] = [replace(row, status="interrupted") if row.status in ("waiting", "running") else row for row in rows]
            write()
            raise
    return BatchResult(directory, tuple(ranked(rows)), batch.keys)


def _lines(result: BatchResult, *, strict: bool = False) -> Iterator[str]:
    table: list[Sequence[str]] = [BatchRow.COLUMNS]
    for row in result.rows:
        *cells, reasons = row.cells()
        first, *more = reasons.splitlines() or [""]
        table += [[*cells, first], *([*("" for _ in cells), each] for each in more)]
    yield columns(table)
    yield f"\nsummary   {result.directory / PAGE}"
    if result.failed:
        others = "; the others are done" if len(result.failed) < len(result.rows) else ""
        raise PhotonpanoError(f"{len(result.failed)} of {counted(len(result.rows), 'run')} failed{others}")
    if strict and (doubtful := [row for row in result.rows if row.verdict != "trusted"]):
        raise DoubtfulError(f"{counted(len(doubtful), 'run is', 'runs are')} doubtful, and --strict accepts only trusted ones")


@command(
    "scan.yaml 'captures/*.npy' --output runs/night --jobs 2",
    _lines,
    notes=True,
    spec=SPEC,
    captures=typer.Argument(metavar="[CAPTURE]..."),
    lists=typer.Option("--from", metavar="LIST"),
    sweep=typer.Option(metavar="KEY=VALUE,VALUE"),
    jobs=typer.Option("--jobs", "-j", metavar="N", min=1),
)
def _batch(  # noqa: PLR0913
    spec: Path,
    output: Path,
    captures: Sequence[str] = (),
    *,
    lists: Sequence[Path] = (),
    changes: Sequence[str] = (),
    sweep: Sequence[str] = (),
    jobs: int = 1,
    overwrite: bool = False,
    progress: Progress | None = None,
) -> BatchResult:
    """Run one spec on many captures, and write one summary.

    Each capture takes the place of the spec's source.with.path, and gets a run folder of its name. A run that fails, crashes
    or is killed becomes a row that says why. What is finished is not run again. summary.html and summary.csv can be watched
    meanwhile. Exits with 1 if a run failed.

    Args:
        spec: a YAML file.
        output: the folder of all run folders and of the summary.
        captures: files, folders, URLs, and patterns in quotes, such as 'captures/*.npy'. A folder that is no capture stands for
            those in it.
        lists: a text file with one capture a line, relative to its folder; # begins a comment. - is standard input.
        changes: change a value of the spec in all runs, such as run.seed=1. A list sweeps, as in levels.0.scale=[0.5,1], unless
            the key takes a list.
        sweep: run each capture with each of these values, such as resample.with.group_size=50,100. Every combination is run.
        jobs: how many runs go on at once; they share the cores.
        overwrite: as in `run`, for each run folder.
        progress: receives a note for each run that ends.
    """
    try:
        prepared = prepare_batch(spec, captures, output, lists=lists, changes=changes, swept=sweep)
    except InputError as error:
        raise WrongArgumentError(str(error)) from error
    return run_batch(prepared, jobs, progress, overwrite=overwrite)


def _require_right(
    problems_of: Callable[[Sequence[str]], tuple[Problem, ...]], common: Sequence[str], settings: Sequence[Mapping[str, Any]]
) -> None:
    """Raise `SpecError` with all problems of any of the settings, each once, that do not depend on the capture."""
    found: dict[tuple[str, str], Problem] = {}
    for setting in settings:
        for each in problems_of([*common, *(override(key, value) for key, value in setting.items())]):
            if each.where == CAPTURE_KEY and each.message.startswith(("expected", "unknown key")):
                found["source.use", ""] = replace(each, where="source.use", message=_NO_FILE, override=None)
            elif not is_of_capture(each.where):
                found.setdefault((each.where, each.message), each)
    if found:
        raise SpecError(list(found.values()))


def _make(directory: Path) -> None:
    """Make the folder of a batch; `OutputError` if it is a file, or cannot be made."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        reason = "" if os.access(directory, os.W_OK | os.X_OK) else "it may not be written to"
    except OSError as error:
        reason = error.strerror or str(error)
    if reason:
        raise OutputError(f"{directory} cannot be the folder of a batch: {reason}; choose another one with --output")


def _line(row: BatchRow) -> str:
    if row.status == "failed":
        return f"{row.label}: failed: {row.reason.partition(chr(10))[0]}"
    error = row.expected_error_px
    expected = "" if error is None else f", expected error {pixels(error)} px"
    return f"{row.label}: {row.verdict}{expected}{', finished before' if row.was_finished else ''}"
