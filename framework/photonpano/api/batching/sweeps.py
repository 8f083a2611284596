"""The settings of a batch: what `--set` changes for all runs, and what is swept, in every combination."""

from __future__ import annotations

import hashlib
import itertools
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from photonpano.errors import Problem, SpecError
from photonpano.files.paths import Location, Url, as_written
from photonpano.plugins.registry import Catalog
from photonpano.record.batch_row import BatchRow, written
from photonpano.specs import Plan, parse_spec
from photonpano.specs.written import Place
from photonpano.specs.yaml_reader import read_yaml

CAPTURE_KEY, OUTPUT_KEY = "source.with.path", "output.directory"
_LONGEST_NAME = 120  # maximum length of the settings in the name of a folder; file systems allow 255 bytes
_UNSAFE = re.compile(r"[^\w.,=+\-]")


@dataclass(frozen=True, slots=True)
class SpecText:
    """A spec as it was when the batch began: a file that is edited meanwhile does not change the runs to come.

    Relative paths count from `directory`; `file` is None for plain data.
    """

    content: str | Mapping[str, Any]
    directory: Path
    file: Path | None = None

    def plan(self, overrides: Sequence[str], output: Path, catalog: Catalog | None = None) -> Plan:
        """Resolve the spec with overrides; `SpecError` if it is wrong."""
        name = self.file.stem if self.file else "spec"
        return parse_spec(
            self.content,
            directory=self.directory,
            name=name,
            overrides=overrides,
            output=output,
            catalog=catalog,
            file=self.file,
        )


@dataclass(frozen=True, slots=True)
class Job:
    """What a process needs to do one run of a batch; it can be pickled. `threads` counts if the spec leaves that open."""

    row: BatchRow
    spec: SpecText
    overrides: tuple[str, ...]
    threads: int
    overwrite: bool = False


def is_of_capture(where: str) -> bool:
    """Return whether a problem of a spec, by its path there, concerns the capture."""
    return where in ("source", CAPTURE_KEY)


def capture_override(capture: Location) -> str:
    """Return the override that replaces the capture of the spec."""
    return override(CAPTURE_KEY, as_written(capture if isinstance(capture, Url) else capture.absolute()))


def override(key: str, value: Any) -> str:
    """Return an override that sets a key to a value; JSON is YAML."""
    return f"{key}={json.dumps(value, ensure_ascii=False)}"


def read_changes(
    changes: Iterable[str], swept: Iterable[str], takes_list: Callable[[str, str], bool]
) -> tuple[list[str], dict[str, list[Any]]]:
    """Separate the overrides for all runs from the values of each swept key.

    Args:
        changes: overrides such as `run.seed=1`. A list sweeps, as in `levels.0.scale=[0.5, 1]`, where the key takes no list.
        swept: such as `resample.with.group_size=50,100`; with brackets or without.
        takes_list: returns whether a key, given with its override, takes the list.

    Raises:
        SpecError: with all problems.
    """
    common: list[str] = []
    found: dict[str, list[Any]] = {}
    problems: list[Problem] = []
    for text, is_sweep in [*((each, False) for each in changes), *((each, True) for each in swept)]:
        key, sign, yaml = text.partition("=")
        key = key.strip()
        place = Place(key, override=text)
        if not sign or not all(key.split(".")):
            problems.append(Place(override=text).problem("expected KEY=VALUE, such as run.seed=1"))
            continue
        if key in (CAPTURE_KEY, OUTPUT_KEY):
            what = "the captures of a batch" if key == CAPTURE_KEY else "the folder of a batch"
            problems.append(place.problem(f"{what} are given beside the spec" if key == CAPTURE_KEY else f"{what} is --output"))
            continue
        unread: list[Problem] = []
        read = read_yaml(f"[{yaml}]" if is_sweep else yaml, place, unread).plain()
        if is_sweep and unread:
            problems += unread
        elif is_sweep or (isinstance(read, list) and read and not takes_list(key, text)):
            values = read[0] if is_sweep and len(read) == 1 and isinstance(read[0], list) else read
            unique = list({json.dumps(value): value for value in values}.values())
            if key in found:
                problems.append(place.problem("is swept twice; give all of its values at once"))
            elif not unique:
                problems.append(place.problem("expected values with commas between them, such as 50,100,200"))
            found.setdefault(key, unique)
        else:
            common.append(text)
    if problems:
        raise SpecError(problems)
    return common, found


def combinations(swept: Mapping[str, Sequence[Any]]) -> list[dict[str, Any]]:
    """Return every combination of the values of swept keys; one without any if nothing is swept."""
    return [dict(zip(swept, values, strict=True)) for values in itertools.product(*swept.values())]


def folder_name(capture: str, settings: Mapping[str, Any]) -> str:
    """Return the name of a run folder: that of the capture, and its settings, as in `night,levels=2,run.seed=1`.

    Settings that are long, or hold characters that file systems or shells do not take, are shortened and end in a hash.
    """
    text = ",".join(f"{key}={written(value)}" for key, value in settings.items())
    safe = _UNSAFE.sub("_", text)
    if safe != text or len(text) > _LONGEST_NAME:
        safe = f"{safe[:_LONGEST_NAME]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"
    return f"{capture},{safe}" if settings else capture
