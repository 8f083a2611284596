"""Follow a capture until it is complete: locate its frames as they arrive, and show the picture so far."""

from __future__ import annotations

import errno
import logging
import math
import os
import shlex
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from photonpano.compiling import notify_on_first_compile
from photonpano.contracts.attribution import attributing
from photonpano.contracts.protocols import Piped
from photonpano.errors import InputError, OutputError, PhotonpanoError, described
from photonpano.execution.context import Context, Progress
from photonpano.execution.threads import one_thread_inside, thread_count
from photonpano.files.atomic import locked
from photonpano.pipeline.following.arrivals import Arrivals, Spool
from photonpano.pipeline.following.live_run import Every, LiveRun
from photonpano.pipeline.following.picture import PAGE, LivePage, PictureSoFar, rehearse
from photonpano.pipeline.run_folder import run_folder
from photonpano.pipeline.run_steps import COMPILING
from photonpano.plugins.contributions import PartOfCapture, SourceContribution
from photonpano.record.fingerprint import capture_files
from photonpano.report import LiveFigures
from photonpano.specs.plan import Plan
from photonpano.text import counted, duration

logger = logging.getLogger(__name__)

SPOOL = "frames.raw"  # the copy of the frames of a pipe
_REFRESH_S = 1.0
_NOTE_S = 10.0
# Minimum time between windows: each locates the last exposure of the one before again, so that long ones are faster.
_WINDOW_S = 0.2
_IDLE_S = 0.1  # maximum wait for frames between two updates of the page


def live_folder(run_directory: Path) -> Path:
    """Return the folder of the page, beside a run folder."""
    return run_directory.with_name(f"{run_directory.name}.live")


@contextmanager
def followed(plan: Plan, progress: Progress, *, overwrite: bool, end_after: float) -> Iterator[tuple[Plan, LiveFigures]]:
    """Follow a capture until it is complete; the block then runs the whole of it, and the page says how that ended.

    A capture on standard input is copied to a file in the `live_folder`, as it comes. Yields the plan that runs the capture,
    which is now in a file, and how far behind its frames were located. For `overwrite`, `end_after` and errors, see `run`.
    """
    directory = plan.output.directory.absolute()
    folder = live_folder(directory)
    look = _followable(plan)
    with ExitStack() as stack:
        stack.enter_context(_made(folder))
        stack.enter_context(locked(folder, f"the folder {folder}"))
        what = look(plan.source.config)
        spool: Spool | None = None
        spooled = folder / SPOOL
        if isinstance(what, Piped):
            plan = plan.having("source", path=spooled)
        with run_folder(directory, overwrite=overwrite, inputs=capture_files(plan)):
            pass  # a folder that cannot be written is refused now, not when the capture is complete
        if isinstance(what, Piped):
            spool = Spool(_standard_input(), _free(spooled, plan, overwrite), what)
            stack.callback(spool.close)
        page = LivePage(folder, directory)
        arrivals = Arrivals(partial(look, plan.source.config), None if spool is None else lambda: spool.ended, end_after)
        stack.callback(arrivals.close)
        progress.note(f"following the capture; {folder / PAGE} shows the panorama so far")
        try:
            figures = _located_so_far(plan, arrivals, page, progress)
            arrivals.close()
            if spool is not None:
                spool.close()
                spool.require_whole()
            _require_complete(plan, arrivals, end_after)
            page.write(replace(figures, state="finishing"))
            yield plan, figures
            page.write(replace(figures, state="finished"))
        except BaseException as error:
            arrivals.close()  # before the spool, which may remove the file that is watched
            if spool is not None:
                spool.close()
                if spool.path.exists():
                    logger.warning(f"the frames that arrived are in {spool.path}; {_way_on(plan)}")
            message = str(error) if isinstance(error, PhotonpanoError) else described(error)
            page.end("interrupted" if isinstance(error, KeyboardInterrupt) else message, arrivals.n_frames)
            raise


def _followable(plan: Plan) -> Callable[[Any], Any]:
    """Return the function that opens the part of the capture that has arrived: an `Arrived`, or a `Piped`."""
    contribution, config = plan.source.contribution, plan.source.config
    assert isinstance(contribution, SourceContribution)
    if plan.pose is not None:
        raise InputError("a spec with 'pose' cannot be followed: poses need the whole capture; run it without --follow")
    if contribution.arrived is None:
        raise InputError(
            f"{plan.source.label} cannot read a capture that is still being written; run it without --follow once it is "
            "complete, or have frames written one after the other, for the source packed-raw"
        )
    if isinstance(config, PartOfCapture) and config.frames is not None:
        raise plan.error("source.with.frames", "a part of a capture cannot be followed; remove this key")
    return attributing(plan.source.label, "the frames so far")(contribution.arrived)


def _standard_input() -> int:
    """Return the descriptor of standard input; `InputError` if it is closed, or a terminal."""
    if sys.__stdin__ is None or sys.__stdin__.closed or os.isatty(0):
        raise InputError("no frames come on standard input; write PROGRAM | photonpano run SPEC --follow")
    return 0


@contextmanager
def _made(folder: Path) -> Iterator[None]:
    """Make a folder, and remove it after the block if it is empty."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = "there is a file of this name" if error.errno == errno.EEXIST else error.strerror
        raise OutputError(f"the folder {folder} cannot be made ({reason}); choose another one with --output") from error
    try:
        yield
    finally:
        with suppress(OSError):
            folder.rmdir()


def _free(path: Path, plan: Plan, overwrite: bool) -> Path:
    """Remove the file, and return its path; `OutputError` if it holds the frames of an earlier capture."""
    if path.exists() and path.stat().st_size and not overwrite:
        raise OutputError(
            f"{path} holds the frames of an earlier capture: {_way_on(plan)}. To follow another capture, choose another folder "
            "with --output, or replace these frames with --overwrite"
        )
    path.unlink(missing_ok=True)
    return path


def _way_on(plan: Plan) -> str:
    """Return how to run the frames that were copied from a pipe."""
    path = str(plan.document["source"]["with"]["path"])
    if plan.file is None:
        return f"run them with source.with.path = {path!r}, and without follow"
    words = ["photonpano", "run", str(plan.file), "--set", f"source.with.path={path}", "--output", str(plan.output.directory)]
    return f"run them with `{shlex.join(words)}`"


def _require_complete(plan: Plan, arrivals: Arrivals, end_after: float) -> None:
    """Raise `InputError` if no frame has come, or fewer than the capture promises."""
    where = plan.document["source"]["with"].get("path", "the capture")
    waited = f"within {end_after:g} s"
    if not arrivals.n_frames:
        raise InputError(f"{where}: no frame has come {waited}; check the path, or wait longer with --end-after")
    if arrivals.promised is not None and arrivals.n_frames < arrivals.promised:
        raise InputError(
            f"{where} holds {arrivals.n_frames:,} of the {arrivals.promised:,} frames that it promises, and no more have come "
            f"{waited}: its writer has died, or pauses for longer. Then wait longer with --end-after. Otherwise record it "
            "again, or read the frames that are there with the source packed-raw and its key header_bytes"
        )


def _located_so_far(plan: Plan, arrivals: Arrivals, page: LivePage, progress: Progress) -> LiveFigures:
    """Locate frames as they arrive, until no more come, and write the page each second."""
    context = Context(thread_count(plan.run.threads))
    run, picture = LiveRun(plan, arrivals, context), PictureSoFar()
    page.write(LiveFigures())
    with one_thread_inside(), notify_on_first_compile(partial(progress.note, COMPILING)):
        arrivals.wait(_IDLE_S)
        if not arrivals.n_frames:
            rehearse(plan, context)
        refresh, note, warn = Every(_REFRESH_S), Every(_NOTE_S, at_once=False), Every(math.inf)
        while True:
            begun, ended = time.monotonic(), arrivals.ended
            if window := run.next_window(last=ended):
                picture.add(window)
            figures = run.figures()
            if refresh.due() or ended:
                page.write(figures, picture)
            if note.due():
                behind = f"{figures.behind_frames:,} are not located yet, the first for {duration(figures.behind_s)}"
                progress.note(f"following: {counted(figures.frames, 'frame')} so far; {behind}")
            if run.is_too_slow and warn.due():
                logger.warning(
                    "frames come faster than they are located; none is lost, and the result is the same. Larger groups "
                    "(resample.with.group_size), or the first level at a smaller scale, take less time"
                )
            if ended:
                return figures
            if window is None:
                arrivals.wait(_IDLE_S)
            else:
                time.sleep(max(0.0, begun + _WINDOW_S - time.monotonic()))
