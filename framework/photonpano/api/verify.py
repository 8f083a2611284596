"""Verify that a run folder is as its run wrote it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from photonpano.api.command import command
from photonpano.errors import InputError, SpecError
from photonpano.pipeline.components import open_source
from photonpano.plugins.registry import Catalog
from photonpano.record.contents import changed_files, changes, fingerprint, recorded_contents
from photonpano.record.run_json import read_record
from photonpano.record.schema import CaptureRecord
from photonpano.specs import parse_spec
from photonpano.text import byte_size, counted


@dataclass(frozen=True, slots=True)
class Verification:
    """What `verify` found.

    Attributes:
        n_files: number of files that were compared.
        n_bytes: their size.
        problems: what is not as the run left it, a clause each.
        capture: what became of the capture, if that is no problem: a clause.
        folder: the run folder.
    """

    n_files: int
    n_bytes: int
    problems: tuple[str, ...]
    capture: str
    folder: Path = Path()


def _lines(found: Verification) -> Iterator[str]:
    if found.problems:
        raise InputError(f"{found.folder} is not as its run wrote it: {'; '.join(found.problems)}")
    yield f"files     {counted(found.n_files, 'file')}, {byte_size(found.n_bytes)}, as the run wrote them"
    yield f"capture   {found.capture}"


@command("runs/first", _lines)
def verify(run_folder: Path | str, catalog: Catalog | None = None) -> Verification:
    """Verify that a run folder is as its run wrote it.

    Compares the size and SHA-256 of each file with `run.json`, and the capture with its fingerprint there.

    Args:
        run_folder: written by `run`.
        catalog: what can be chosen; by default what the installed plugins offer.

    Raises:
        InputError: the folder is no run folder.
    """
    folder = Path(run_folder)
    record = read_record(folder)
    recorded = recorded_contents(folder)
    problems = [] if recorded else ["run.json lists no files"]
    problems += [f"{name} is missing" for name in recorded if not os.path.lexists(folder / name)]
    problems += [f"{name} is not the file that the run wrote" for name in changed_files(folder)]
    others, capture = _capture(folder, record["spec"], record.get("capture"), catalog)
    size = sum(content["bytes"] for content in recorded.values())
    return Verification(len(recorded), size, (*problems, *others), capture, folder)


def _capture(folder: Path, spec: object, old: CaptureRecord | None, catalog: Catalog | None) -> tuple[list[str], str]:
    """Return the problems of the capture; and if there are none, what became of it."""
    if old is None:
        return [], "not compared: run.json has no fingerprint of it"
    try:
        plan = parse_spec(spec, name=str(folder / "run.json"), catalog=catalog)  # type: ignore[arg-type]  # checked there
        with open_source(plan) as source:
            new = fingerprint(plan, source)
    except SpecError as error:
        return [], f"not compared: {error.problems[0].message}"
    except InputError as error:
        return [], f"not compared: {error}"
    found = changes(old, new)
    sizes = [[(file["path"], file["bytes"]) for file in record["files"]] for record in (old, new)]
    same = sizes[0] == sizes[1] and all(old[key] == new[key] for key in ("frames_sha256", "pixels_sha256"))
    return ([], "; ".join(["the same frames", *found])) if same else (found, "")
