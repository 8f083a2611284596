"""The work folder: it stands beside the run folder, and holds what a run has found until the run is finished.

Each record is a pickle with a digest, in a file of its own that is written whole.
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import logging
import os
import pickle
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

import photonpano
from photonpano.errors import InputError, OutputError, PhotonpanoError
from photonpano.execution.context import Checkpoints, KeepNothing, Progress
from photonpano.files.folders import atomic_path
from photonpano.pipeline.components import scale_of
from photonpano.record.contents import changed_files, changes
from photonpano.record.run_json import library_versions, plugin_records, read_record
from photonpano.record.schema import CaptureRecord, RunRecord
from photonpano.specs.plan import Choice, Plan
from photonpano.text import byte_size, counted
from photonpano.values import Decision, Journal

logger = logging.getLogger(__name__)

ResultT = TypeVar("ResultT")

MANIFEST = "work.json"
FORMAT = 2
_SHOWN = 3  # differences that a message names
SUFFIX = ".pickle"
_OLD_SUFFIX = ".npz"  # up to version 0.2
_DIGEST_BYTES = hashlib.sha256().digest_size  # a record begins with the SHA-256 of the rest
_SPARE = 8  # free space, in sizes of a record, that must remain for the results
FLUSH_S = 5.0  # time between writes of a log: a kill loses at most this much work
_END = "end"
Fingerprint = dict[str, Any]
_STAGES = ("resample", "merge", "locate", "interpolate")


@dataclass(frozen=True, slots=True)
class Continuation:
    """What a run takes from the run before."""

    resume: bool = False  # go on with an interrupted run of the same spec
    # take the levels before this one, and compute this one and everything after it; None to take none
    from_level: int | None = None
    keep: bool = False  # keep the work folder when the run is finished, for `from_level`


class Work:
    """The work of a run; its `checkpoints` keep what the run finds."""

    def __init__(self, folder: Path | None, now: Fingerprint, keep: bool) -> None:
        self._folder, self._now, self._keep = folder, now, keep
        self._store = None if folder is None else Store(folder)
        self._kept = None if self._store is None else Kept(self._store)
        self.checkpoints: Checkpoints = self._kept or KeepNothing()
        self._finished = False

    def finish(self) -> None:
        """Remove the work, or keep it for other runs: the results are written."""
        self._finished = True
        if self._folder is None:
            return
        if self._keep:
            with _harmless():
                _write_manifest(self._folder, self._now, finished=True)
        else:
            _remove(self._folder)

    def close(self, *, failed: bool = False) -> bool:
        """Write what has not been written yet; return whether there is work to go on with.

        A run that `failed` would fail again, so that only finished levels are of use.
        """
        if self._finished or self._kept is None or self._store is None or self._folder is None:
            return False
        self._kept.flush()
        useful = finished(self._store, "level-1") if failed else self._store.holds_something
        if not useful:
            _remove(self._folder)
        return useful


def path_of(run_folder: Path) -> Path:
    """Return the path of the work folder of a run: `runs/scan.work` for `runs/scan`."""
    place = run_folder.absolute().resolve()
    return place.with_name(f"{place.name}.work")


@contextmanager
def work_folder(run_folder: Path, now: Fingerprint, how: Continuation, progress: Progress) -> Iterator[Work]:
    """Open the work folder of a run, whose lock is held; `InputError` if levels before `how.from_level` cannot be taken.

    What it holds stays after an interruption or an error. Where nothing can be kept, a warning says so, and the run goes on.
    """
    folder = path_of(run_folder)
    _require_levels(folder, now, how.from_level)
    try:
        _prepare(folder, now, how, progress)
        work = Work(folder, now, how.keep or how.from_level is not None)
    except (OutputError, OSError) as error:
        reason = error.strerror or error if isinstance(error, OSError) else error
        logger.warning(
            "%s: what the run finds cannot be kept (%s); if it is interrupted, all of it is computed again", folder, reason
        )
        work = Work(None, now, keep=False)
    try:
        yield work
    except BaseException as error:
        if work.close(failed=isinstance(error, PhotonpanoError) and not isinstance(error, OutputError)):
            progress.note(f"{folder} holds what was found; with --resume, the run goes on from there")
        raise
    work.close()


def _prepare(folder: Path, now: Fingerprint, how: Continuation, progress: Progress) -> None:
    """Clear the work folder of what this run may not reuse; `OutputError` if it is the folder of somebody else."""
    there = os.path.lexists(folder)
    if there and not _is_ours(folder):
        raise OutputError("it is there already, and is not the work folder of a run")
    manifest = _manifest(folder)
    if how.from_level is not None:
        _clear(folder, from_level=how.from_level)
    elif how.resume and there:
        reasons = _why_not(manifest, now)
        if not reasons:
            progress.note(f"going on with the interrupted run, from {folder}")
            for file in filter(_is_record, folder.glob(".*")):  # what a killed process was writing
                file.unlink(missing_ok=True)
            return
        logger.warning("%s: the interrupted run is not continued, but started again: %s", folder, _named(reasons))
        _clear(folder)
    elif how.resume:
        progress.note("there is no interrupted run to go on with: the run starts at the beginning")
    elif there:
        if manifest is None or not manifest["finished"]:
            if _why_not(manifest, now):
                progress.note(f"{folder} held the work of an interrupted run of something else; it is replaced")
            else:
                logger.warning(
                    "%s held the work of an interrupted run, which --resume would have continued; it is replaced", folder
                )
        _clear(folder)
    folder.mkdir(parents=True, exist_ok=True)
    _write_manifest(folder, now, finished=False)


def _require_levels(folder: Path, now: Fingerprint, from_level: int | None) -> None:
    """Raise `InputError` if levels to start from are missing, or were found in another way."""
    if from_level is None:
        return
    n_levels, option = len(now["levels"]), f"--from-level {from_level}"
    if not 2 <= from_level <= n_levels + 1:
        raise InputError(f"{option}: the spec has {n_levels} levels; expected 2 to {n_levels + 1}")
    manifest = _manifest(folder) if _is_ours(folder) else None
    if manifest is None:
        raise InputError(f"{option}: there is no work folder {folder}; run with --keep-work first")
    store = Store(folder)
    n_finished = next((level - 1 for level in range(1, n_levels + 1) if not finished(store, f"level-{level}")), n_levels)
    if not n_finished:
        raise InputError(f"{option}: {folder} holds no finished level; run without the option")
    if n_finished < from_level - 1:
        expected = "2" if n_finished == 1 else f"2 {'or' if n_finished == 2 else 'to'} {n_finished + 1}"
        raise InputError(f"{option}: {folder} holds {counted(n_finished, 'finished level')}; expected {expected}")
    if reasons := differences(manifest["fingerprint"], now, from_level - 1):
        raise InputError(
            f"{option}: the levels before it were found in another way: {_named(reasons)}; run without the option, or from an "
            "earlier level"
        )


def _why_not(manifest: dict[str, Any] | None, now: Fingerprint) -> list[str]:
    if manifest is None:
        return [f"{MANIFEST} is missing or damaged"]
    return differences(manifest["fingerprint"], now)


def _named(reasons: list[str]) -> str:
    more = f", and {len(reasons) - _SHOWN} more" if len(reasons) > _SHOWN else ""
    return ", ".join(reasons[:_SHOWN]) + more


def _manifest(folder: Path) -> dict[str, Any] | None:
    """Read the manifest; None if there is none that this version can read."""
    try:
        found = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        differences(found["fingerprint"], found["fingerprint"])
        return {"finished": bool(found["finished"]), **found} if found["format"] == FORMAT else None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None


def _write_manifest(folder: Path, now: Fingerprint, *, finished: bool) -> None:
    with atomic_path(folder / MANIFEST) as temporary:
        text = json.dumps({"format": FORMAT, "finished": finished, "fingerprint": now}, indent=1)
        temporary.write_text(text, encoding="utf-8")


def _is_ours(folder: Path) -> bool:
    """Return whether a folder holds nothing but what runs keep in it."""
    return folder.is_dir() and not folder.is_symlink() and all(map(_is_record, folder.iterdir()))


def _is_record(path: Path) -> bool:
    """Return whether a run has written a file, or was about to."""
    return path.name == MANIFEST or path.suffix in (SUFFIX, _OLD_SUFFIX) or ".partial" in path.suffixes


def _clear(folder: Path, from_level: int = 1) -> None:
    """Remove what was kept, but the levels before one; the manifest last, which names what the rest depends on."""
    taken = tuple(f"level-{level}{end}" for level in range(1, from_level) for end in ".-")
    files = [each for each in folder.iterdir() if _is_record(each)] if folder.is_dir() else []
    for file in sorted(files, key=lambda each: each.name == MANIFEST):
        if not file.name.startswith(taken):
            file.unlink(missing_ok=True)


def _remove(folder: Path) -> None:
    with _harmless():
        _clear(folder)
        folder.rmdir()


@contextmanager
def _harmless() -> Iterator[None]:
    """Warn of what goes wrong with the work folder when it is not needed any more."""
    try:
        yield
    except (OSError, OutputError) as error:
        logger.warning("the work folder could not be changed: %s", error)


class Store:
    """Named records in an existing folder. One that is damaged or cannot be written gives a warning, and is computed again."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.holds_something = any(folder.glob(f"[!.]*{SUFFIX}"))
        self._warned = False

    def save(self, name: str, value: Any) -> bool:
        """Write a record; return whether it was possible."""
        path = self.folder / f"{name}{SUFFIX}"
        try:
            record = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
            free = shutil.disk_usage(self.folder).free
            if free < (1 + _SPARE) * len(record):
                raise OutputError(
                    f"{self.folder}: what was found is not kept, as the {byte_size(free)} free are for the results"
                )
            # A record that a power failure damages is computed again; waiting for the disk would cost more.
            with atomic_path(path, flushed=False) as temporary:
                temporary.write_bytes(hashlib.sha256(record).digest() + record)
        except Exception as error:  # pickle raises what it likes for a result of a plugin that it cannot keep
            if not self._warned:
                logger.warning("%s; the run goes on, but if it is interrupted, this is computed again", error)
            self._warned = True
            return False
        self.holds_something = True
        return True

    def load(self, name: str) -> Any:
        """Read a record; None if there is none, or it is damaged."""
        path = self.folder / f"{name}{SUFFIX}"
        if not path.exists():
            return None
        content = path.read_bytes()
        record = content[_DIGEST_BYTES:]
        if hashlib.sha256(record).digest() != content[:_DIGEST_BYTES]:
            logger.warning("%s is damaged, and is computed again", path)
            path.unlink(missing_ok=True)
            return None
        return pickle.loads(record)

    def names(self, start: str) -> list[str]:
        """Return the names of the records that begin with a text, in order."""
        return sorted(path.name.removesuffix(SUFFIX) for path in self.folder.glob(f"{start}*{SUFFIX}"))


class Kept:
    """Checkpoints in a store: see `photonpano.execution.context.Checkpoints`.

    Decisions of components are kept with the results that they were taken for, and taken again when these are found.
    """

    def __init__(self, store: Store, given: tuple[Any, ...] = (), logs: list[KeptLog] | None = None) -> None:
        """Open the checkpoints of a run; all results depend on `given`, beside what the whole store is for."""
        self._store, self._given = store, given
        self._logs: list[KeptLog] = [] if logs is None else logs

    def once(self, step: str, compute: Callable[[], ResultT], *given: Any, decisions: Journal | None = None) -> ResultT:
        """See `photonpano.execution.context.Checkpoints`."""
        name, decisions = self._name(step, given), [] if decisions is None else decisions
        if (found := self._store.load(name)) is not None:
            kept: ResultT
            kept, taken = found
            decisions += taken
            return kept
        before = len(decisions)
        result = compute()
        self._store.save(name, (result, decisions[before:]))
        return result

    def log(self, step: str, *given: Any, decisions: Journal | None = None) -> KeptLog:
        """See `photonpano.execution.context.Checkpoints`."""
        log = KeptLog(self._store, self._name(step, given), [] if decisions is None else decisions)
        self._logs.append(log)
        return log

    def within(self, *given: Any) -> Kept:
        """See `photonpano.execution.context.Checkpoints`."""
        return Kept(self._store, (*self._given, *given), self._logs)

    def flush(self) -> None:
        """Write what the logs have not written yet."""
        for log in self._logs:
            log.flush()

    def _name(self, step: str, given: tuple[Any, ...]) -> str:
        return f"{step}.{digest(*self._given, *given)}"


class KeptLog:
    """Results of a step with many of them, in files of what was found within some seconds: see `context.Log`."""

    def __init__(self, store: Store, name: str, decisions: Journal) -> None:
        self._store, self._name, self._decisions = store, name, decisions
        self._restored: list[Decision] = []
        self._first_decision = len(decisions)
        self.found: list[Any] = []
        for batch in store.names(f"{name}."):
            if batch != self._batch(len(self.found)) or (kept := store.load(batch)) is None:
                continue
            results, taken = kept
            self.found += results
            self._restored = list(taken)
        self._written = len(self.found)
        self._pending: list[Any] = []
        self._flushed = time.monotonic()

    def add(self, result: Any) -> None:
        """See `photonpano.execution.context.Log`."""
        self._pending.append(result)
        if time.monotonic() - self._flushed >= FLUSH_S:
            self.flush()

    def finish(self) -> None:
        """See `photonpano.execution.context.Log`."""
        self.flush()
        for decision in self._restored:
            if decision not in self._decisions[self._first_decision :]:
                self._decisions.append(decision)
        if not self._store.names(finished := f"{self._name}.{_END}"):
            self._store.save(finished, None)

    def flush(self) -> None:
        """Write the results that were added since the last time."""
        self._flushed = time.monotonic()
        taken = [*self._restored, *self._decisions[self._first_decision :]]
        if self._pending and self._store.save(self._batch(self._written), (self._pending, taken)):
            self._written += len(self._pending)
            self._pending = []

    def _batch(self, first: int) -> str:
        """Return the name of the file whose first result has this number."""
        return f"{self._name}.{first:08d}"


def finished(store: Store, step: str) -> bool:
    """Return whether a log of a step was finished."""
    return any(name.endswith(f".{_END}") for name in store.names(f"{step}."))


def digest(*values: Any) -> str:
    """Return a hash of numbers, texts, arrays, and the dataclasses, mappings and sequences that hold them.

    It has 32 hexadecimal digits. Pickles do not serve: those of equal values may differ.
    """
    found = hashlib.blake2b(digest_size=16)
    for part in _parts(values):
        found.update(part)
    return found.hexdigest()


def _parts(value: Any) -> Iterator[bytes]:
    if isinstance(value, np.ndarray):
        yield f"{value.dtype.str} {value.shape} ".encode()
        yield value.tobytes()
    elif is_dataclass(value):
        yield type(value).__name__.encode()
        yield from _parts([getattr(value, each.name) for each in fields(value)])
    elif isinstance(value, Mapping):
        yield from _parts(list(value.items()))
    elif isinstance(value, Sequence) and not isinstance(value, str):
        yield f"{len(value)} ".encode()
        for item in value:
            yield from _parts(item)
    else:
        yield f"{value!r} ".encode()


def run_fingerprint(plan: Plan, capture: CaptureRecord, frame_shape: tuple[int, int]) -> Fingerprint:
    """Return what the results of a run depend on, as plain data; neither the threads nor the run folder.

    Returns:
        `versions`, `code` and `capture`, on which everything depends; `common`, the parts of the spec on which it does;
            `levels`, a list; and `rest`, what only the steps after the last level depend on.
    """
    document = plan.document
    rest = {
        "refine": [_component(choice) for choice in plan.refine],
        "render": {**document["render"], **_component(plan.renderer), "code": _code([plan.renderer])},
        "memory": int(plan.run.memory),
        "formats": [{**_component(choice), "code": _code([choice])} for choice in plan.formats],
    }
    found = {
        "versions": {"photonpano": importlib.metadata.version("photonpano"), **library_versions(plan)},
        "code": _code([plan.source], photonpano),
        "capture": capture,
        "common": {
            "source": _component(plan.source),
            "corrections": document.get("corrections"),
            **{section: document[section] for section in ("motion", "camera", "light", "graph")},
            "run.seed": plan.run.seed,
            "render.reference": document["render"]["reference"],
        },
        "levels": [_level(plan, number, frame_shape) for number in range(1, len(plan.levels) + 1)],
        "rest": rest,
    }
    as_read: Fingerprint = json.loads(json.dumps(found))
    return as_read


def differences(before: Fingerprint, now: Fingerprint, levels: int | None = None) -> list[str]:
    """Return what differs between two fingerprints, a clause each; with `levels`, only what these levels depend on."""
    found = [
        f"the version of {path} was {old} and is {new}" for path, old, new in _changed(before["versions"], now["versions"])
    ]
    found += [f"the code of {path} has changed" for path, _, _ in _changed(before["code"], now["code"])]
    found += changes(before["capture"], now["capture"])
    found += _settings(before["common"], now["common"])
    if levels is None and len(before["levels"]) != len(now["levels"]):
        found.append(f"there were {len(before['levels'])} levels and are {len(now['levels'])}")
    for number, (old, new) in enumerate(zip(before["levels"][:levels], now["levels"][:levels], strict=False), start=1):
        found += _settings(old, new, f" at level {number}")
    return found if levels is not None else found + _settings(before["rest"], now["rest"])


def finished_run(plan: Plan, capture: CaptureRecord) -> RunRecord | None:
    """Return the record in the run folder of a plan, if it is of this spec, capture and software, and unchanged."""
    try:
        record = read_record(plan.output.directory)
        same = (
            record["photonpano"] == importlib.metadata.version("photonpano")
            and record["libraries"] == library_versions(plan)
            and record["plugins"] == plugin_records(plan)
            and _without_machine(record["spec"]) == _without_machine(plan.document)
            and not changes(record["capture"], capture)
            and all((plan.output.directory / name).exists() for name in record["files"])
            and not changed_files(plan.output.directory)
            and (plan.output.keep is None or record["spec"]["output"].get("keep") == plan.output.keep)
        )
        return record if same and record["verdict"] is not None else None
    except (InputError, KeyError, TypeError, AttributeError):
        return None


def _without_machine(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a spec as plain data, without what results do not depend on: the run folder, threads, and executor."""
    run = {key: value for key, value in document["run"].items() if key not in ("threads", "executor")}
    plain: dict[str, Any] = json.loads(json.dumps({**document, "run": run}))
    plain.pop("output", None)
    return plain


def _level(plan: Plan, number: int, frame_shape: tuple[int, int]) -> dict[str, Any]:
    level = plan.levels[number - 1]
    choices = {stage: getattr(level, stage) for stage in _STAGES}
    return {
        "scale": scale_of(plan, number, frame_shape),
        **{stage: _component(choice) for stage, choice in choices.items()},
        "fallback": [_component(choice) for choice in level.fallbacks],
        "code": _code([*choices.values(), *level.fallbacks]),
    }


def _component(choice: Choice) -> dict[str, Any]:
    return {
        "use": choice.contribution.name,
        "plugin": f"{choice.origin.plugin} {choice.origin.version}",
        "with": choice.config.model_dump(mode="json"),
    }


def _code(choices: Sequence[Choice], *packages: Any) -> dict[str, str]:
    """Return hashes of the Python files of plugins, by package: while its author works on a plugin, its version stays."""
    built_by = (sys.modules.get(choice.contribution.build.__module__.partition(".")[0]) for choice in choices)
    return {
        module.__name__: _hash_of(module.__file__) for module in (*packages, *built_by) if getattr(module, "__file__", None)
    }


@cache
def _hash_of(file: str) -> str:
    """Hash a module; of a package, all its Python files."""
    path, found = Path(file), hashlib.blake2b(digest_size=16)
    files = sorted(path.parent.rglob("*.py")) if path.name == "__init__.py" else [path]
    for each in files:
        found.update(f"{each.relative_to(path.parent)}\0".encode())
        found.update(hashlib.sha256(each.read_bytes()).digest())
    return found.hexdigest()


def _settings(before: Any, now: Any, where: str = "") -> list[str]:
    return [
        f"the code of {path.removeprefix('code.')} has changed"
        if path.startswith("code.")
        else f"{path} was {_short(old)} and is {_short(new)}{where}"
        for path, old, new in _changed(before, now)
    ]


def _changed(before: Any, now: Any, path: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield the places where two values of plain data differ, with both values; None stands for nothing."""
    if isinstance(before, Mapping) and isinstance(now, Mapping):
        for key in dict.fromkeys([*before, *now]):
            yield from _changed(before.get(key), now.get(key), f"{path}.{key}" if path else key)
    elif before != now:
        yield path, before, now


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
