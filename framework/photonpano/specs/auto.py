"""Find the source that `auto` stands for: the one that recognises the path."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from heapq import nsmallest
from itertools import islice
from typing import TYPE_CHECKING

from photonpano.contributions import SourceContribution
from photonpano.reading import missing_file
from photonpano.registry.auto import AUTO, AutoConfig, ask_sources
from photonpano.registry.kinds import KINDS
from photonpano.specs.checks import complaints
from photonpano.specs.plan import Choice
from photonpano.specs.tree import Value, from_data, joined
from photonpano.specs.validation import validate
from photonpano.text import listed
from photonpano.values import Decision

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from photonpano.errors import Problem
    from photonpano.registry import Catalog, Entry

logger = logging.getLogger(__name__)

_SHOWN = 3
"""So many names of a folder are shown."""
_LOOKED_AT = 1000
"""So many files of a folder tell whose they could be."""


@dataclass(frozen=True, slots=True)
class Found:
    """The source that recognises a capture.

    Attributes:
        name: what specs call it.
        keys: what a spec would say under its `with`: what it recognised, and what was written beside the path.
        path: the capture.
        because: a clause that says why.
    """

    name: str
    keys: Value
    path: Path
    because: str

    @property
    def decision(self) -> Decision:
        """What the record of a run says of it."""
        return Decision(KINDS[AUTO.kind].section, self.name, f"{self.path.name} is taken for it: {self.because}")

    def blamed(self, problems: list[Problem]) -> list[Problem]:
        """Say of problems with its keys why a source is asked that nobody named."""
        why = f"{self.path.name} is taken for {self.name}: {self.because}"
        return [replace(each, message=f"{each.message} ({why})") for each in problems]


def found_source(keys: Value, catalog: Catalog, directory: Path, problems: list[Problem]) -> Found | None:
    """Ask the sources of a catalog which of them recognises a capture.

    Args:
        keys: what is written under the `with` of a section that uses `auto`.
        catalog: whom to ask.
        directory: what relative paths count from.
        problems: what is wrong is added here: no path, nobody who recognises it, or several.
    """
    written = keys.content if isinstance(keys.content, dict) else {}
    own = {key: value for key, value in written.items() if key in AutoConfig.model_fields}
    config = validate(AutoConfig, replace(keys, content=own) if written else keys, directory, problems)
    if config is None:
        return None
    path, place = config.path, own["path"].place
    if not path.exists():
        problems.append(place.problem(missing_file(path, "file or folder")))
        return None
    answers = ask_sources(catalog, path)
    if len(answers.recognised) != 1:
        several = [f"{entry.name} ({answer.because})" for entry, answer in answers.recognised]
        if several:
            message = f"{path} is recognised by {listed(several)}; name the right one"
        else:
            # The path is named once; each line has its last part.
            near = [line.replace(str(path), path.name) for line in _near_misses(keys, catalog, directory, path)]
            lines = [*(near or _known_endings(catalog)), *answers.failures]
            message = "\n  ".join([f"no source recognises {path}, {_looks(path)}; name the one that reads it", *lines])
        problems.append(place.problem(message))
        return None
    for failure in answers.failures:
        logger.warning(failure)
    ((entry, answer),) = answers.recognised
    recognised = from_data(answer.keys, problems, place).content
    assert isinstance(recognised, dict)
    given = {
        key: replace(value, place=replace(place, where=joined(keys.place.where, key))) for key, value in recognised.items()
    }
    others = {key: value for key, value in written.items() if key not in own}
    return Found(entry.name, replace(keys, content=given | others), path, answer.because)


def _near_misses(keys: Value, catalog: Catalog, directory: Path, path: Path) -> Iterator[str]:
    """Yield what each source whose files it could be, and that could be told the same keys, has against the capture."""
    endings = {each.suffix.lower() for each in ([path] if path.is_file() else islice(path.rglob("*"), _LOOKED_AT))}
    for entry in catalog.rows:
        if isinstance(entry.contribution, SourceContribution) and entry.contribution is not AUTO:
            suffixes = entry.contribution.suffixes
            if not suffixes or endings & {*suffixes}:
                yield from (f"{entry.name}: {each}" for each in _complaints(entry, keys, directory))


def _known_endings(catalog: Catalog) -> list[str]:
    """Say what the files of captures are called."""
    sources = [each.contribution for each in catalog.rows if isinstance(each.contribution, SourceContribution)]
    endings = sorted({suffix for source in sources for suffix in source.suffixes})
    return [f"the names of files of captures end in {listed(endings)}"] if endings else []


def _complaints(entry: Entry, keys: Value, directory: Path) -> tuple[str, ...]:
    try:
        config = validate(entry.contribution.config, keys, directory, [])
    except Exception:  # it takes other keys, and what is wrong with its config is said when it is named
        return ()
    if config is None:
        return ()
    return complaints(Choice(entry.contribution, config, entry.origin))


def _looks(path: Path) -> str:
    """Say what was looked at."""
    if path.is_file():
        return f"a file of {path.stat().st_size:,} bytes"
    try:
        names = nsmallest(_SHOWN + 1, (each.name for each in path.iterdir()))
    except OSError as error:
        return f"which cannot be read ({error.strerror})"
    if len(names) > _SHOWN:
        return f"a folder of {', '.join(names[:_SHOWN])} and more"
    return f"a folder of {listed(names)}" if names else "an empty folder"
