"""Load specs: from files, and from Python."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from photonpano.errors import Problem, SpecError
from photonpano.registry import Catalog, discover
from photonpano.specs.overrides import apply_override
from photonpano.specs.resolution import resolve
from photonpano.specs.tree import Place, Value, from_data
from photonpano.specs.yaml_reader import read_yaml

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from photonpano.specs.plan import Plan

MAX_BYTES = 2**20
"""No spec is as long as this; a capture that is given by mistake is."""


def load_spec(
    path: str | Path,
    overrides: Sequence[str] = (),
    output: str | Path | None = None,
    catalog: Catalog | None = None,
) -> Plan:
    """Load a spec file and resolve it.

    Args:
        path: the file; relative paths in it count from its folder.
        overrides: values to change, such as `run.seed=1` or `levels.0.scale=0.5`; list indices count from 0.
        output: the run folder, relative to the current folder, in place of the spec's `output.directory`.
        catalog: what can be chosen; by default what the installed plugins offer.

    Raises:
        SpecError: the file cannot be read, or the spec is wrong; carries all problems, each with line and column.
    """
    path = Path(path)
    text = _read(path)
    return _load(text, Place(file=path), path.parent.absolute(), path.stem, overrides, output, catalog)


def parse_spec(
    spec: Mapping[str, Any] | str,
    *,
    directory: str | Path = ".",
    name: str = "spec",
    overrides: Sequence[str] = (),
    output: str | Path | None = None,
    catalog: Catalog | None = None,
) -> Plan:
    """Resolve a spec that is given as plain data, or as the text of a YAML file.

    Args:
        spec: the spec; a `Plan.document` is one.
        directory: what relative paths in it count from.
        name: names the run folder, `runs/NAME`, of a spec that does not say.
        overrides: values to change, such as `run.seed=1`.
        output: the run folder, relative to the current folder, in place of the spec's `output.directory`.
        catalog: what can be chosen; by default what the installed plugins offer.

    Raises:
        SpecError: the spec is wrong; carries all problems.
    """
    return _load(spec, Place(), Path(directory).absolute(), name, overrides, output, catalog)


def _read(path: Path) -> str:
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except FileNotFoundError:
        problem = Problem("", "there is no such file", path)
    except IsADirectoryError:
        problem = Problem("", "this is a folder, expected a spec in YAML", path)
    except OSError as error:
        problem = Problem("", f"cannot be read: {error.strerror}", path)
    else:
        if len(data) > MAX_BYTES:
            raise SpecError([Problem("", f"no spec: longer than {MAX_BYTES} bytes", path)])
        try:
            return data.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            start = data.rfind(b"\n", 0, error.start) + 1
            line = data.count(b"\n", 0, error.start) + 1
            message = f"not UTF-8 text, got the byte {data[error.start]:#04x}; save the file as UTF-8"
            problem = Problem("", message, path, line, error.start - start + 1)
    raise SpecError([problem])


def _load(
    spec: Mapping[str, Any] | str,
    place: Place,
    directory: Path,
    name: str,
    overrides: Sequence[str],
    output: str | Path | None,
    catalog: Catalog | None,
) -> Plan:
    problems: list[Problem] = []
    root = read_yaml(spec, problems, place) if isinstance(spec, str) else from_data(spec, problems, place)
    if root is None or root.content is None:
        start = place if root is None else root.place
        raise SpecError(problems or [start.problem("the spec is empty; it needs at least `version` and `source`")])
    for override in overrides:
        apply_override(root, override, problems)
    _set_output(root, None if output is None else Path(output).absolute(), Path("runs", name))
    return resolve(root, directory, discover() if catalog is None else catalog, problems)


def _set_output(root: Value, chosen: Path | None, default: Path) -> None:
    """Set the run folder: the chosen one, or the default where the spec names none."""
    if not isinstance(root.content, dict):
        return
    place = Place("output", root.place.file)
    section = root.content.setdefault("output", Value(None, place, place))
    if section.content is None:
        section.content = {}
    if isinstance(section.content, dict) and (chosen is not None or "directory" not in section.content):
        section.content["directory"] = Value(str(chosen or default), replace(place, where="output.directory"))
