"""Load specs: from files, and from Python."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from photonpano.errors import Problem, SpecError
from photonpano.files.paths import Location, location, refusal
from photonpano.plugins.registry import Catalog, discover
from photonpano.specs.builtin import ask_sources, known_endings
from photonpano.specs.plan import Plan, Spec
from photonpano.specs.resolution import resolve
from photonpano.specs.yaml_reader import Place, Written, from_python, given, joined, read_yaml

SPEC_SUFFIXES = {".yaml", ".yml"}
MAX_LENGTH = 2**18  # bytes of a spec: a capture that is given by mistake is longer


def load_spec(
    path: str | Path,
    overrides: Sequence[str] = (),
    output: str | Path | None = None,
    catalog: Catalog | None = None,
    arriving: bool = False,
) -> Plan:
    """Load a spec file and resolve it. A capture in its place is that of a spec with all defaults.

    Args:
        path: the file; relative paths in it count from its folder.
        overrides: values to change, such as `run.seed=1` or `levels.0.scale=0.5`; list indices count from 0. If they name
            another capture, its name is added to that of the default run folder.
        output: the run folder, relative to the current folder, in place of the spec's `output.directory`.
        catalog: what can be chosen; by default what the installed plugins offer.
        arriving: whether the capture is still being written, so that its files are not checked: see `run` with `follow`.

    Raises:
        SpecError: the file cannot be read, or the spec is wrong; carries all problems, each with line and column.
    """
    path, catalog = Path(path), discover() if catalog is None else catalog
    parsed = partial(
        parse_spec,
        directory=path.parent,
        name=path.stem,
        overrides=overrides,
        output=output,
        catalog=catalog,
        arriving=arriving,
    )
    try:
        return parsed(read_spec(path), file=path)
    except SpecError:
        if path.suffix.lower() in SPEC_SUFFIXES or not path.exists() or not _is_capture(catalog, path):
            raise
    return parsed({"version": 1, "source": {"use": "auto", "with": {"path": path.name}}})


def _is_capture(catalog: Catalog, path: Path) -> bool:
    """Return whether a file is a capture, or is called like one: what no source recognises is refused as such."""
    return bool(ask_sources(catalog, path)[0]) or path.suffix.lower() in known_endings(catalog)


def parse_spec(
    spec: Mapping[str, Any] | str,
    *,
    directory: str | Path = ".",
    name: str = "spec",
    overrides: Sequence[str] = (),
    output: str | Path | None = None,
    catalog: Catalog | None = None,
    file: Path | None = None,
    arriving: bool = False,
) -> Plan:
    """Resolve a spec that is given as plain data, or as the text of a YAML file.

    Args:
        spec: the spec; a `Plan.document` is one.
        directory: what relative paths in it count from.
        name: the name of the run folder, `runs/NAME`, unless the spec has an `output.directory`. If `overrides` name another
            capture than the spec, it is `runs/NAME-CAPTURE`.
        overrides: values to change, such as `run.seed=1`.
        output: the run folder, relative to the current folder, in place of the spec's `output.directory`.
        catalog: what can be chosen; by default what the installed plugins offer.
        file: what the text was read from, for messages and for the record of a run.
        arriving: whether the capture is still being written, so that its files are not checked: see `run` with `follow`.

    Raises:
        SpecError: the spec is wrong; carries all problems.
    """
    problems: list[Problem] = []
    place = Place(file=file)
    root = read_yaml(spec, place, problems) if isinstance(spec, str) else from_python(spec, place, problems)
    if root.data is None:
        raise SpecError(problems or [root.place.problem("the spec is empty; it needs at least `version` and `source`")])
    own = _capture(root)
    for override in overrides:
        root = _overridden(root, override, problems)
    other = _capture(root)
    named = name if other in (own, None) or refusal(Path(str(other))) else f"{name}-{other}"
    root = _with_output(root, None if output is None else Path(output).absolute(), Path("runs", named))
    catalog = discover() if catalog is None else catalog
    return resolve(Spec(root, catalog, Path(directory).absolute(), arriving, problems))


def capture_plan(
    path: str | Location,
    keys: Mapping[str, Any] | None = None,
    *,
    source: str = "auto",
    corrections: Sequence[Any] | None = None,
    overrides: Sequence[str] = (),
    catalog: Catalog | None = None,
) -> Plan:
    """Make the plan of a capture without a spec.

    Args:
        path: the file or folder, relative to the current folder, or its URL.
        keys: keys of its source, such as `{"frame_rate_hz": 96_800}`.
        source: the source that reads it; by default the one that recognises it.
        corrections: a list of corrections, as in a spec; `auto` by default.
        overrides: other values of the spec, such as `run.threads=2`.
        catalog: what can be chosen; by default what the installed plugins offer.

    Raises:
        SpecError: no source recognises the capture, or a key or a correction is wrong.
    """
    section = {"use": source, "with": {"path": path, **(keys or {})}}
    spec = {"version": 1, "source": section, "corrections": None if corrections is None else list(corrections)}
    return parse_spec(spec, overrides=overrides, catalog=catalog)


def read_spec(path: Path) -> str:
    """Return the text of a spec file; `SpecError` if it cannot be read, or is too long for a spec."""
    if reason := refusal(path):
        raise SpecError([Problem(where="", message=reason.removeprefix(f"{path} "), file=path)])
    try:
        with path.open("rb") as file:
            data = file.read(MAX_LENGTH + 1)
        if len(data) <= MAX_LENGTH:
            return data.decode("utf-8-sig")
        problem = Problem(where="", message=f"not a spec: longer than {MAX_LENGTH} bytes", file=path)
    except FileNotFoundError:
        problem = Problem(where="", message="there is no such file", file=path)
    except IsADirectoryError:
        problem = Problem(where="", message="this is a folder, expected a spec in YAML", file=path)
    except OSError as error:
        problem = Problem(where="", message=f"cannot be read: {error.strerror}", file=path)
    except UnicodeDecodeError as error:
        start = data.rfind(b"\n", 0, error.start) + 1
        line = data.count(b"\n", 0, error.start) + 1
        message = f"not UTF-8 text, got the byte {data[error.start]:#04x}; save the file as UTF-8"
        problem = Problem(where="", message=message, file=path, line=line, column=error.start - start + 1)
    raise SpecError([problem])


def _capture(root: Written) -> str | None:
    """Return the names of the capture and its folder, such as `night-cube` for `captures/night/cube.npy`; None without one."""
    written = root.at("source", "with", "path").data
    if not isinstance(written, str):
        return None
    path = Path(str(location(written)))  # without the secrets of a URL
    parts = (*path.parts[:-1][-1:], path.name.split(".")[0])
    return "-".join(part for part in parts if part not in ("", "/", ".", "..")) or None


def _overridden(root: Written, text: str, problems: list[Problem]) -> Written:
    """Return a spec with one value changed; mappings on the way to it are made where they are missing.

    The text, such as `levels.0.scale=0.5`, has keys and list indices (from 0), then a value in YAML. If it is wrong, that is
    added to the problems, and the spec stays as it is.
    """
    path, sign, yaml = text.partition("=")
    keys = path.strip().split(".")
    if not sign or not all(keys):
        problems.append(Place(override=text).problem("expected KEY=VALUE, such as run.seed=1"))
        return root
    n_problems = len(problems)
    value = read_yaml(yaml, Place(where=path.strip(), override=text), problems)
    if len(problems) > n_problems:
        return root
    try:
        return _changed(root, keys, value)
    except LookupError as error:
        problems.append(value.place.problem(str(error.args[0])))
        return root


def _changed(node: Written, keys: list[str], value: Written) -> Written:
    """Return a value of a spec with one of the values in it replaced; `LookupError` with a message if it has none."""
    if not keys:
        return value
    key, *rest = keys
    place = Place(where=joined(node.place.where, key), override=value.place.override)
    if isinstance(node.data, list) and key.isdecimal() and int(key) < len(node.data):
        items = list(node.data)
        items[int(key)] = _changed(items[int(key)], rest, value)
        return Written(items, node.place)
    if node.data is None:
        return Written({key: _changed(Written(None, place), rest, value)}, node.place)
    if not isinstance(node.data, dict):
        raise LookupError(f"{node.place.where or 'the spec'} is {given(node.data)}, which has no {key!r}")
    return node.having({key: _changed(node.data.get(key, Written(None, place)), rest, value)})


def _with_output(root: Written, chosen: Path | None, default: Path) -> Written:
    """Return a spec with a run folder: the chosen one, or the default where the spec names none."""
    section = root.at("output")
    if not isinstance(root.data, dict) or not isinstance(section.data, dict | None):
        return root
    if chosen is None and "directory" in (section.data or {}):
        return root
    directory = Written(str(chosen or default), Place(where="output.directory", file=root.place.file))
    return root.having({"output": section.having({"directory": directory})})
