"""Follow a capture until it is complete: run the frames that are there again and again, and show the panorama so far."""

from __future__ import annotations

import errno
import json
import logging
import os
import select
import shlex
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, replace
from pathlib import Path
from shutil import rmtree
from typing import Any
from urllib.parse import quote

from photonpano.contracts.attribution import attributing
from photonpano.contracts.protocols import Arrived, Piped, Source
from photonpano.errors import InputError, OutputError, PhotonpanoError, described
from photonpano.execution.context import Progress
from photonpano.files.folders import atomic_path, locked
from photonpano.pipeline.run_folder import run_folder
from photonpano.plugins.contributions import PartOfCapture, SourceContribution
from photonpano.record.contents import capture_files
from photonpano.report import LiveFigures, render_live
from photonpano.specs.plan import Plan
from photonpano.text import counted

logger = logging.getLogger(__name__)

PAGE, FIGURES = "live.html", "live.json"
SO_FAR = "so-far"  # the run folder of the frames so far
SPOOL = "frames.raw"  # the copy of the frames of a pipe
_LOOK_S, _NOTE_S = 0.5, 10.0  # time between two looks at the capture, and between two lines
_TOLERATED_S = 1.0  # time for which an unreadable capture is tolerated: files may appear in any order
_GROWTH = 1.25  # the frames so far are run when there are that many times as many as at the last run
_TIME_LIMIT_S = 1e-3  # of a run of the frames so far: it ends after the first level


@contextmanager
def followed(
    plan: Plan, run: Callable[[Plan], object], progress: Progress, *, overwrite: bool, end_after: float
) -> Iterator[Plan]:
    """Follow a capture until it is complete; the block then runs the whole of it, and the page says how that ended.

    A capture on standard input is copied to a file beside the run folder, in `DIR.live`. Yields the plan that runs the capture,
    which is now in a file. `run` runs a plan of the frames so far. For `overwrite`, `end_after` and errors, see `pipeline.run`.
    """
    directory, look = plan.output.directory.absolute(), _followable(plan)
    folder = directory.with_name(f"{directory.name}.live")
    with ExitStack() as stack:
        stack.enter_context(_made(folder))
        stack.enter_context(locked(folder, f"the folder {folder}"))
        arrived, spool = look(plan.source.config), None
        if isinstance(arrived, Piped):
            plan = plan.having("source", path=folder / SPOOL)
        with run_folder(directory, overwrite=overwrite, inputs=capture_files(plan)):
            pass  # a folder that cannot be written is refused now, not when the capture is complete
        if isinstance(arrived, Piped):
            spool = Spool(_standard_input(), _free(folder / SPOOL, plan, overwrite), arrived)
            stack.callback(spool.close)
        page = _Page(folder, directory.name)
        progress.note(f"following the capture; {folder / PAGE} shows the panorama so far")
        try:
            _follow(plan, run, look, page=page, progress=progress, spool=spool, end_after=end_after)
            page.write(state="finishing", message="")
            yield plan
            page.write(state="finished")
        except BaseException as error:
            rmtree(folder / f"{SO_FAR}.work", ignore_errors=True)  # of a run of the frames so far that was interrupted
            n_frames = page.figures.frames
            if spool is not None:
                spool.close()
                n_frames = spool.n_frames()
                if spool.path.exists():
                    logger.warning(f"the frames that arrived are in {spool.path}; {_way_on(plan)}")
            reason = str(error) if isinstance(error, PhotonpanoError) else described(error)
            page.end("interrupted" if isinstance(error, KeyboardInterrupt) else reason, n_frames)
            raise


def _follow(
    plan: Plan,
    run: Callable[[Plan], object],
    look: Callable[[Any], Arrived],
    *,
    page: _Page,
    progress: Progress,
    spool: Spool | None,
    end_after: float,
) -> None:
    """Run the frames that are there whenever there are more, until no more come; `InputError` if some are missing then."""
    tried = 0
    changed = noted = time.monotonic()
    while True:
        piping = spool is not None and spool.is_copying()  # asked first: the look finds all frames that came before
        arrived, now = _looked(look, plan), time.monotonic()
        n_frames = 0 if arrived.source is None else arrived.source.info.n_frames
        if n_frames > page.figures.frames:
            changed = now
            page.write(state="following", frames=n_frames, promised=arrived.promised)
        silent = spool is None and now - changed > end_after
        if silent or (n_frames and n_frames == arrived.promised) or not (spool is None or piping):
            break
        if now - noted > _NOTE_S:
            noted = now
            progress.note(f"following: {counted(n_frames, 'frame')} so far, {page.figures.shown:,} of them in the picture")
        if arrived.source is not None and n_frames > tried and n_frames >= _GROWTH * tried:
            tried = n_frames
            page.write(**_run_so_far(plan, run, arrived.source, page.folder))
        else:
            time.sleep(_LOOK_S)
    if spool is not None:
        spool.require_whole()
    _require_complete(plan, n_frames, arrived.promised, end_after)


def _run_so_far(plan: Plan, run: Callable[[Plan], object], source: Source, folder: Path) -> dict[str, Any]:
    """Run the first level of a plan on the frames so far, and return what the page says of it.

    A failure ends nothing: more frames may be what lacks, and the run of the whole capture says what else does.
    """
    n_frames, choice = source.info.n_frames, plan.source
    part = replace(
        plan.having("output", directory=folder / SO_FAR, keep=None).having("run", time_limit=_TIME_LIMIT_S),
        source=replace(choice, contribution=replace(choice.contribution, build=lambda *_: source)),
        formats=(),
        executor=None,
        observers=(),
    )
    try:
        run(part)
    except PhotonpanoError as error:
        return {"message": f"{counted(n_frames, 'frame')} gave no panorama: {error}"}
    return {"shown": n_frames, "message": ""}


def _looked(look: Callable[[Any], Arrived], plan: Plan) -> Arrived:
    """Open the frames that are there; `InputError` if they are no capture, and still none a moment later."""
    with suppress(InputError):
        return look(plan.source.config)
    time.sleep(_TOLERATED_S)
    return look(plan.source.config)


def _followable(plan: Plan) -> Callable[[Any], Any]:
    """Return the function that opens the part of the capture that has arrived: an `Arrived`, or a `Piped`."""
    contribution, config = plan.source.contribution, plan.source.config
    assert isinstance(contribution, SourceContribution)
    if plan.kind is not None:
        why = f"{plan.kind.name} need the whole capture; run it without --follow"
        raise InputError(f"a spec with {plan.kind.section!r} cannot be followed: {why}")
    if contribution.arrived is None:
        raise InputError(
            f"{plan.source.label} cannot read a capture that is still being written; run it without --follow once it is "
            "complete, or have frames written one after the other, for the source packed-raw"
        )
    if isinstance(config, PartOfCapture) and config.frames is not None:
        raise plan.error("source.with.frames", "a part of a capture cannot be followed; remove this key")
    return attributing(plan.source.label, "the frames so far")(contribution.arrived)


def _require_complete(plan: Plan, n_frames: int, promised: int | None, end_after: float) -> None:
    """Raise `InputError` if no frame has come, or fewer than the capture promises."""
    where = plan.document["source"]["with"].get("path", "the capture")
    waited = f"within {end_after:g} s"
    if not n_frames:
        raise InputError(f"{where}: no frame has come {waited}; check the path, or wait longer with --end-after")
    if promised is not None and n_frames < promised:
        raise InputError(
            f"{where} holds {n_frames:,} of the {promised:,} frames that it promises, and no more have come "
            f"{waited}: its writer has died, or pauses for longer. Then wait longer with --end-after. Otherwise record it "
            "again, or read the frames that are there with the source packed-raw and its key header_bytes"
        )


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


class _Page:
    """The page of a run that follows a capture, and the file of its figures; those of an earlier run are removed."""

    def __init__(self, folder: Path, title: str) -> None:
        """`title` is the name of the run folder, which lies beside `folder`."""
        self.figures = LiveFigures()
        self.folder = folder
        self._title, self._failed = title, False
        self._remove()
        self.write()

    def write(self, **changes: Any) -> None:
        """Change figures, and write the page. If the disk is full, a warning says so, once: the run goes on."""
        self.figures = replace(self.figures, **changes)
        page = render_live(self.figures, self._title, f"{SO_FAR}/", f"../{quote(self._title)}/")
        try:
            for name, text in ((PAGE, page), (FIGURES, f"{json.dumps(asdict(self.figures), indent=2)}\n")):
                with atomic_path(self.folder / name, flushed=False) as temporary:
                    temporary.write_text(text, encoding="utf-8")
        except OutputError as error:
            if not self._failed:
                logger.warning(f"the page of the run is not up to date: {error}")
            self._failed = True

    def end(self, reason: str, n_frames: int) -> None:
        """Say why the run has stopped after a number of frames; without any, there is no page."""
        if n_frames:
            self.write(state="stopped", frames=n_frames, message=reason)
        else:
            self._remove()

    def _remove(self) -> None:
        for name in (PAGE, FIGURES):
            (self.folder / name).unlink(missing_ok=True)


def _standard_input() -> int:
    """Return the descriptor of standard input; `InputError` if it is closed, or a terminal."""
    if sys.__stdin__ is None or sys.__stdin__.closed or os.isatty(0):
        raise InputError("no frames come on standard input; write PROGRAM | photonpano run SPEC --follow")
    return 0


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


class Spool:
    """Copies a pipe to a file in a thread, until the pipe ends or the spool is closed."""

    _BUFFER_BYTES = 1024**2
    _WAIT_S = 0.2  # time until a spool notices that it is closed

    def __init__(self, descriptor: int, path: Path, piped: Piped) -> None:
        """Make the file, which must not be there, and begin to copy; `OutputError` if it cannot be made."""
        self.path = path
        self._pipe, self._piped, self._rest = descriptor, piped, 0
        self._failure: OSError | None = None
        self._stopped = threading.Event()
        try:
            self._file = path.open("xb", buffering=0)
        except OSError as error:
            raise OutputError(f"cannot write {path}: {error.strerror}; choose another folder with --output") from error
        self._thread = threading.Thread(target=self._copy, name="spool", daemon=True)
        self._thread.start()

    def is_copying(self) -> bool:
        """Return whether more frames may come."""
        return self._thread.is_alive()

    def close(self) -> None:
        """Stop copying. What is no whole frame is cut off, and a file without any frame removed."""
        self._stopped.set()
        self._thread.join()
        if self._file.closed:
            return
        with self._file:
            size = self._file.seek(0, os.SEEK_END)
            self._rest = max(0, size - self._piped.header_bytes) % self._piped.frame_bytes
            self._file.truncate(size - self._rest)
        if not self.n_frames():
            self.path.unlink()

    def require_whole(self) -> None:
        """Close a pipe that has ended; raise why it could not be copied, or that it ended before or within a frame."""
        self.close()
        n_frames = self.n_frames()
        kept = f"; the {n_frames:,} whole {'frame is' if n_frames == 1 else 'frames are'} in {self.path}" if n_frames else ""
        if self._failure is not None:
            raise OutputError(f"cannot copy standard input to {self.path}: {self._failure.strerror}{kept}; make room")
        if not n_frames and not self._rest:
            raise InputError("standard input ended before the first frame: look why the program that writes to it has ended")
        if self._rest:
            raise InputError(
                f"standard input ended within a frame: after {n_frames:,} frames of {self._piped.frame_bytes:,} bytes came "
                f"{self._rest:,} bytes more. Either the program that writes has died, or height and width are wrong{kept}"
            )

    def n_frames(self) -> int:
        """Return the number of whole frames in the file."""
        size = self.path.stat().st_size if self.path.exists() else 0
        return max(0, size - self._piped.header_bytes) // self._piped.frame_bytes

    def _copy(self) -> None:
        try:
            while not self._stopped.is_set():
                if not select.select([self._pipe], [], [], self._WAIT_S)[0]:
                    continue
                left = memoryview(os.read(self._pipe, self._BUFFER_BYTES))
                if not left:
                    break
                while left:
                    left = left[self._file.write(left) :]
        except OSError as error:
            self._failure = error
