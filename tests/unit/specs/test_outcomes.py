"""What becomes of specs, as `outcomes.txt` tells: what differs from the defaults, with places, or all problems.

Each case is a title, sections that are added to a minimal spec, and overrides. `--stream` checks a short capture as well.
Outcomes are written anew by `python tests/unit/specs/test_outcomes.py`; read what has changed before you commit it.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest
from ruamel.yaml import YAML, YAMLError

from photonpano import (
    Config,
    ExporterContribution,
    LocatorContribution,
    Requirement,
    ResamplerContribution,
    SourceContribution,
    SpecError,
    StreamInfo,
)
from photonpano.plugins.description import flow
from photonpano.plugins.registry import Catalog
from photonpano.specs import Plan, check_stream, json_schema, parse_spec

CASES = Path(__file__).with_name("outcomes.txt")
SHORT = StreamInfo(n_frames=100, height=8, width=16, frame_rate_hz=None)
MINIMAL = "version: 1\n"
SOURCE = "source: {use: simulator}\n"


class Keys(Config):
    """No keys."""


class Sized(Config):
    at_least: int = 0


def fail(*_: object) -> Any:
    raise ZeroDivisionError("oops")


def too_short(config: Sized, info: StreamInfo) -> list[str]:
    return [f"the capture has fewer than {config.at_least} frames"] if info.n_frames < config.at_least else []


def with_more(catalog: Catalog) -> Catalog:
    """Add exporters, and components whose checks fail."""
    suffixes = {"hdr": ".hdr", "radiance": ".hdr", "pgm": ".pgm", "exr": ".exr"}
    missing = (Requirement("there_is_no_such_module", "photonpano[exr]"),)
    return catalog.including(
        *(
            ExporterContribution(
                name=name, summary="Toy", config=Keys, suffix=suffix, build=fail, requires=missing if name == "exr" else ()
            )
            for name, suffix in suffixes.items()
        ),
        LocatorContribution(name="sized", summary="Toy", config=Sized, build=fail, check=too_short),
        ResamplerContribution(name="careless", summary="Toy", config=Keys, build=fail, check=fail),
        ResamplerContribution(name="terse", summary="Toy", config=Keys, build=fail, check=lambda *_: "too dark"),
        SourceContribution(name="broken", summary="Toy", config=Keys, build=fail, check=fail),
    )


def cases() -> dict[str, tuple[list[str], list[str]]]:
    """Return input and outcome of each case."""
    blocks = (block.splitlines() for block in CASES.read_text(encoding="utf-8").split("\n\n"))
    split = {title: [line for line in lines if line] for title, *lines in blocks}
    return {
        title: (
            [line for line in lines if not line.startswith("-> ")],
            [line.removeprefix("-> ") for line in lines if line.startswith("-> ")],
        )
        for title, lines in split.items()
    }


def leaves(data: Any, where: str = "") -> Iterator[tuple[str, str]]:
    """Yield the paths of a document, and what stands there."""
    inside = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    if not inside or (isinstance(data, list) and not any(isinstance(each, dict) for each in data)):
        yield where, flow(data)
        return
    for key, value in inside:
        yield from leaves(value, f"{where}.{key}" if where else str(key))


def outcome(written: list[str], catalog: Catalog, validator: jsonschema.Draft202012Validator) -> list[str]:
    """Return the lines of an outcome; an editor marks a spec, unless a line says so, exactly if it has problems."""
    overrides = [line.removeprefix("--set ") for line in written if line.startswith("--set ")]
    sections = "".join(f"{line}\n" for line in written if not line.startswith("--"))
    text = MINIMAL + ("" if "source:" in sections else SOURCE) + sections
    try:
        plan = parse_spec(text, overrides=overrides, directory="/out", catalog=catalog)
    except SpecError as error:
        overlooked = not overrides and is_valid(text, validator)
        return str(error).splitlines() + ["editors see nothing wrong"] * overlooked
    refused = ["editors refuse it"] * (not overrides and not is_valid(text, validator))
    require_same_again(plan, catalog)
    if "--stream" in written:
        return [str(each) for each in check_stream(plan, SHORT)] or ["it suits"]
    defaults = dict(leaves(parse_spec(MINIMAL + SOURCE, directory="/out", catalog=catalog).document))
    found = dict(leaves(plan.document))
    changed = [f"{path}: {value}{place(plan, path)}" for path, value in found.items() if defaults.get(path) != value]
    changed += [f"{path}: not there" for path in defaults if path not in found]
    return (changed or ["the defaults"]) + refused


def is_valid(text: str, validator: jsonschema.Draft202012Validator) -> bool:
    try:
        return validator.is_valid(YAML(typ="safe", pure=True).load(text))
    except (YAMLError, TypeError, ValueError):
        return False


def place(plan: Plan, path: str) -> str:
    at = plan.place(path)
    return f"  ({'--set' if at.override else f'{at.line}:{at.column}'} {at.where})" if at.is_written else ""


def require_same_again(plan: Plan, catalog: Catalog) -> None:
    """A document is a spec, and resolves to itself."""
    again = parse_spec(json.loads(json.dumps(plan.document)), catalog=catalog)
    assert again.document == plan.document
    assert (again.levels, again.refine) == (plan.levels, plan.refine)
    assert (again.renderer, again.formats) == (plan.renderer, plan.formats)


def told(catalog: Catalog) -> dict[str, list[str]]:
    """Return the outcome of each case."""
    more = with_more(catalog)
    validator = jsonschema.Draft202012Validator(json_schema(more))
    return {
        title: [line.replace(__name__, "HERE") for line in outcome(written, more, validator)]
        for title, (written, _) in cases().items()
    }


@pytest.fixture(scope="module")
def all_told(catalog: Catalog) -> dict[str, list[str]]:
    return told(catalog)


@pytest.mark.parametrize("title", cases())
def test_spec_has_the_outcome(title: str, all_told: dict[str, list[str]]) -> None:
    assert all_told[title] == cases()[title][1]


if __name__ == "__main__":
    from conftest import toys

    outcomes = told(toys())
    blocks = ["\n".join([title, *cases()[title][0], *(f"-> {line}" for line in outcomes[title])]) for title in outcomes]
    CASES.write_text("\n\n".join(blocks) + "\n", encoding="utf-8")
