"""What a spec is resolved against, and the problems that are found with it."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from photonpano.contributions import KINDS
from photonpano.registry import Catalog
from photonpano.specs.settings import SECTIONS, SETTINGS
from photonpano.specs.written import Written, given
from photonpano.text import listed, suggestion

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from photonpano.errors import Problem
    from photonpano.values import Decision


@dataclass
class Spec:
    """A spec while it is resolved.

    Attributes:
        root: the whole spec.
        catalog: what can be chosen.
        directory: what relative paths count from.
        arriving: whether the capture is still being written, so that its files are not checked.
        problems: what is wrong, so far.
        decisions: choices that the spec leaves open and that reading it made.
        remark: added to the message of every problem.
    """

    root: Written
    catalog: Catalog = field(default_factory=Catalog)
    directory: Path = Path()
    arriving: bool = False
    problems: list[Problem] = field(default_factory=list)
    decisions: list[Decision] = field(default_factory=list)
    remark: str = ""

    def wrong(self, value: Written, message: str) -> None:
        """Report a problem with a value."""
        place = value.place
        line, column = place.start or (place.line, place.column)
        self.wrong_key(Written(None, replace(place, line=line, column=column)), message)

    def wrong_key(self, value: Written, message: str) -> None:
        """Report a problem with the key of a value: one that is unknown, or missing."""
        if value.place.is_readable:
            self.problems.append(value.place.problem(message + self.remark))

    def mapping(self, value: Written, example: str = "") -> Written | None:
        """Return a section, where nothing counts as an empty mapping; anything but a mapping is a problem, and None."""
        if value.data is None:
            return Written({}, value.place)
        if isinstance(value.data, dict):
            return value
        self.wrong(value, f"expected a mapping{example}, got {given(value.data)}")
        return None

    def check_keys(self, section: Written, known: Iterable[str], below: Iterable[str] = ()) -> None:
        """Report unknown keys.

        Args:
            section: a mapping.
            known: the keys that it may have.
            below: the keys that the mapping under its `with` may have.
        """
        for key, value in section.data.items():
            if key not in known:
                message = "unknown key; it belongs under `with`" if key in below else self.unknown_key(key, section, known)
                self.wrong_key(value, message)

    def unknown_key(self, key: str, section: Written, known: Iterable[str]) -> str:
        """Return the message for an unknown key: where it belongs, else the nearest of the keys that are known."""
        if key in SECTIONS:
            return f"unknown key; `{key}` is a section of its own, not part of another"
        here = re.sub(r"levels\.\d+\.", "", section.place.where)
        if homes := [f"`{home}`" for home in self._homes(key) if home != here]:
            return f"unknown key; it belongs under {listed(homes, 'or')}"
        return f"unknown key; {suggestion(key, known) or 'no keys are allowed here'}"

    def _homes(self, key: str) -> Iterator[str]:
        """Yield the sections where a key may stand, for the components that the spec chooses."""
        for kind in KINDS.values():
            section = self.root.at(*kind.section.split("."))
            is_list = kind.several and section.data is not None
            for item in section.items() if is_list else [section]:
                name = item.spelled_out().at("use").data or (None if is_list else kind.default)
                if key in self.catalog.keys_of(kind.name, name):
                    yield f"{item.place.where}.with"
        yield from (name for name, model in SETTINGS.items() if key in model.model_fields)
        if key == "fallback":
            yield "locate"
