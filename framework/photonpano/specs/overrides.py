"""Change values of a spec from outside: `a.b=c`, as `photonpano run --set a.b=c` does."""

from __future__ import annotations

from typing import TYPE_CHECKING

from photonpano.specs.tree import Place, Value, given, joined
from photonpano.specs.yaml_reader import read_yaml

if TYPE_CHECKING:
    from photonpano.errors import Problem


def apply_override(root: Value, text: str, problems: list[Problem]) -> None:
    """Set one value; mappings on the way to it are made where they are missing.

    Args:
        root: the spec, which is changed.
        text: such as `run.seed=1` or `levels.0.scale=0.5`: keys and list indices (from 0), then a value in YAML.
        problems: what is wrong with the override is added here.
    """
    path, sign, yaml = text.partition("=")
    keys = path.strip().split(".")
    if not sign or not all(keys):
        problems.append(Place(override=text).problem("expected KEY=VALUE, such as run.seed=1"))
        return
    place = Place(path.strip(), override=text)
    before = len(problems)
    value = read_yaml(yaml, problems, place) or Value(None, place)
    if len(problems) == before:
        value.key = place
        _set(root, keys, value, problems)


def _set(node: Value, keys: list[str], value: Value, problems: list[Problem]) -> None:
    key, *rest = keys
    if node.content is None:
        node.content = {}
    where = node.place.where
    if isinstance(node.content, dict):
        if rest:
            place = Place(joined(where, key), override=value.place.override)
            _set(node.content.setdefault(key, Value({}, place, place)), rest, value, problems)
        else:
            node.content[key] = value
    elif isinstance(node.content, list) and key.isdecimal() and int(key) < len(node.content):
        if rest:
            _set(node.content[int(key)], rest, value, problems)
        else:
            node.content[int(key)] = value
    else:
        problems.append(value.place.problem(f"{where or 'the spec'} is {given(node.content)}, which has no {key!r}"))
