"""Resolve the list of corrections: each a name, or a mapping of one name to its settings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from photonpano.contributions import MergerContribution
from photonpano.corrections import CORRECTIONS, FlatField
from photonpano.reading import missing_file
from photonpano.specs.validation import validate
from photonpano.specs.written import WrittenSpec, given
from photonpano.text import suggestion

if TYPE_CHECKING:
    from collections.abc import Iterable

    from photonpano.contributions import Contribution
    from photonpano.corrections import Correction

AUTO = "auto"
"""`corrections: auto` is the default: the run masks what stands still, and divides by a vignette."""


def resolved_corrections(data: Any, spec: WrittenSpec) -> tuple[Correction, ...] | None:
    """Resolve the section `corrections`; corrections with problems are left out.

    Args:
        data: a list, `auto`, or None, which is `auto` too.
        spec: problems are added here, each at its place.

    Returns:
        The corrections of the list; None for `auto`.
    """
    if data is None or data == AUTO:
        return None
    if not isinstance(data, list):
        spec.wrong("corrections", f"expected a list of corrections, or {AUTO}, got {given(data)}")
        return ()
    found = (_resolved(item, f"corrections.{index}", spec) for index, item in enumerate(data))
    return tuple(correction for correction in found if correction is not None)


def check_flat_field(
    corrections: Iterable[Correction], mergers: Iterable[Contribution], posed: bool, spec: WrittenSpec
) -> None:
    """Refuse a flat field where nothing can be divided by it.

    Args:
        corrections: of the spec.
        mergers: of all levels.
        posed: the run finds poses.
        spec: problems are added here.
    """
    index = next((place for place, each in enumerate(corrections) if isinstance(each, FlatField)), None)
    if index is None:
        return
    refusing = [each.name for each in mergers if isinstance(each, MergerContribution) and not each.accepts_corrected_sums]
    if posed:
        spec.wrong(f"corrections.{index}", "flat-field does not apply with `pose`: it is measured along a panorama; remove it")
    elif refusing:
        message = f"flat-field divides sums of frames, and {refusing[0]!r} merges single frames; choose another merger"
        spec.wrong(f"corrections.{index}", message)


def written_corrections(corrections: Iterable[Correction]) -> list[Any]:
    """Write corrections down as plain data, from which they can be resolved again."""
    settings = ((each.name, each.model_dump(mode="json")) for each in corrections)
    return [{name: keys} if keys else name for name, keys in settings]


def _resolved(item: Any, where: str, spec: WrittenSpec) -> Correction | None:
    if isinstance(item, str):
        name, settings, at = item, None, where
    elif isinstance(item, dict) and len(item) == 1:
        ((name, settings),) = item.items()
        at = f"{where}.{name}"
    else:
        got = f"a mapping of {len(item)}" if isinstance(item, dict) else given(item)
        expected = "the name of a correction, or a mapping of one name to its settings such as {crop: {rows: [2, null]}}"
        spec.wrong(where, f"expected {expected}, got {got}")
        return None
    if name not in CORRECTIONS:
        spec.wrong_key(at, f"there is no correction {name!r}; {suggestion(name, CORRECTIONS)}")
        return None
    correction = validate(CORRECTIONS[name], settings, f"{where}.{name}", spec)
    for key, file in correction or ():
        if isinstance(file, Path) and not file.exists():
            spec.wrong(f"{where}.{name}.{key}", missing_file(file))
    return correction
