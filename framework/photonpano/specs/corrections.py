"""Resolve the list of corrections: each a name, or a mapping of one name to its settings."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from photonpano.corrections import CORRECTIONS, Correction
from photonpano.reading import missing_file
from photonpano.specs.spec import Spec, validate
from photonpano.specs.written import Written, given
from photonpano.text import suggestion

AUTO = "auto"  # the default: the run masks what stands still, and divides by a vignette


def resolved_corrections(written: Written, spec: Spec) -> tuple[Correction, ...] | None:
    """Resolve the section `corrections`: a list, or `auto`, which is the default, and for which it returns None.

    Corrections with problems are left out; these are added to the spec.
    """
    if written.data is None or written.data == AUTO:
        return None
    if not isinstance(written.data, list):
        spec.wrong(written, f"expected a list of corrections, or {AUTO}, got {given(written.data)}")
        return ()
    found = (_resolved(item, spec) for item in written.data)
    return tuple(correction for correction in found if correction is not None)


def written_corrections(corrections: Iterable[Correction]) -> list[Any]:
    """Write corrections down as plain data, from which they can be resolved again."""
    settings = ((each.name, each.model_dump(mode="json")) for each in corrections)
    return [{name: keys} if keys else name for name, keys in settings]


def _resolved(item: Written, spec: Spec) -> Correction | None:
    if isinstance(item.data, str):
        name, named, settings = item.data, item, Written(None, item.place.below(item.data))
    elif isinstance(item.data, dict) and len(item.data) == 1:
        ((name, settings),) = item.data.items()
        named = settings
    else:
        got = f"a mapping of {len(item.data)}" if isinstance(item.data, dict) else given(item.data)
        expected = "the name of a correction, or a mapping of one name to its settings such as {crop: {rows: [2, null]}}"
        spec.wrong(item, f"expected {expected}, got {got}")
        return None
    if name not in CORRECTIONS:
        spec.wrong_key(named, f"there is no correction {name!r}; {suggestion(name, CORRECTIONS)}")
        return None
    correction = validate(CORRECTIONS[name], settings, spec)
    for key, file in correction or ():
        if isinstance(file, Path) and not file.exists():
            spec.wrong(settings.at(key), missing_file(file))
    return correction
