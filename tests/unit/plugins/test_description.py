"""Components in words."""

from enum import Enum
from pathlib import Path
from textwrap import dedent
from typing import Annotated, Any, Literal

import pytest
from pydantic import ByteSize, Field, JsonValue
from ruamel.yaml import YAML

from photonpano import Config, LocatorContribution, Requirement, SpecPath
from photonpano.plugins.description import (
    ConfigRow,
    bounds_words,
    config_rows,
    config_schema,
    expectation,
    snippet,
    type_words,
)


class Inner(Config):
    depth: int = 1


class Mode(Enum):
    FAST = "fast"
    EXACT = "exact"


class Near(Config):
    kind: Literal["near"] = "near"
    seed: int = 0
    radius_px: float = Field(5, gt=0, description="of the search")


class Far(Config):
    kind: Literal["far"] = "far"
    seed: int = 0
    map: SpecPath


class LocatorConfig(Config):
    weights: SpecPath = Field(description="a local file")
    ratio: float = Field(0.8, gt=0, lt=1, description="nearest to second match")
    method: Literal["ransac", "magsac"] = Field("magsac", description="how outliers are found")
    start: Literal["auto"] | Annotated[int, Field(ge=0)] = Field("auto", description="first frame:\nauto # or a number")
    inner: Inner = Inner()
    search: Near | Far = Field(Near(radius_px=7), discriminator="kind", description="where to look")
    label: str | None = Field(None, description="a text for records")
    masks: tuple[str, ...] = Field(("yes", "a b"), description="files")
    passes: tuple[Inner, ...] = ()


def unbuilt(config, context):
    raise AssertionError


LOCATOR = LocatorContribution(
    name="my-locator",
    summary="Finds nothing",
    config=LocatorConfig,
    build=unbuilt,
    requires=(Requirement("torch", "photonpano[torch]"), Requirement("kornia", "photonpano[torch]")),
)


def test_config_rows_have_type_default_and_bounds():
    assert config_rows(LocatorConfig) == (
        ConfigRow("weights", "path", None, "", "a local file"),
        ConfigRow("ratio", "number", "0.8", "above 0 and below 1", "nearest to second match"),
        ConfigRow("method", "ransac or magsac", "magsac", "", "how outliers are found"),
        ConfigRow("start", "auto or integer", "auto", "at least 0", "first frame: auto # or a number"),
        ConfigRow("inner", "mapping", "{depth: 1}", "", ""),
        ConfigRow("inner.depth", "integer", "1", "", ""),
        ConfigRow("search", "mapping", "{kind: near, seed: 0, radius_px: 7}", "", "where to look"),
        ConfigRow("search.kind", "far or near", None, "", "which of these"),
        ConfigRow("search.seed", "integer", "0", "", ""),
        ConfigRow("search.radius_px", "number", "5", "above 0", "of the search (near)"),
        ConfigRow("search.map", "path", None, "", "(far)"),
        ConfigRow("label", "text or null", "null", "", "a text for records"),
        ConfigRow("masks", "list of texts", '["yes", "a b"]', "", "files"),
        ConfigRow("passes", "list of mappings", "[]", "", ""),
        ConfigRow("passes[].depth", "integer", "1", "", ""),
    )


def test_snippet_is_yaml_with_the_defaults():
    written = snippet(LOCATOR)
    assert written == dedent("""\
        locate:
          use: my-locator
          with:
            weights: "<path>"  # a local file
            ratio: 0.8  # nearest to second match
            method: magsac  # how outliers are found
            start: auto  # first frame: auto # or a number
            inner: {depth: 1}
            search: {kind: near, seed: 0, radius_px: 7}  # where to look
            label: null  # a text for records
            masks: ["yes", "a b"]  # files
            passes: []
        """)
    section = YAML(typ="safe", pure=True).load(written)["locate"]
    assert section.pop("use") == "my-locator"
    assert LocatorConfig(**section["with"] | {"weights": "w"}) == LocatorConfig(weights=Path("w"))


class Empty(Config):
    pass


def test_component_without_keys_has_no_rows():
    bare = LocatorContribution(name="bare", summary="A toy", config=Empty, build=unbuilt)
    assert (config_rows(Empty), snippet(bare)) == ((), "locate:\n  use: bare\n")


def wording(annotation: Any, words=expectation):
    config = type("Probe", (Config,), {"__annotations__": {"value": annotation}})
    root = config_schema(config)
    return words(root["properties"]["value"], root)


@pytest.mark.parametrize(
    ("annotation", "words"),
    [
        (int, "an integer"),
        (bool, "true or false"),
        (str, "text"),
        (Path, "a path"),
        (None, "null"),
        (Any, "a value"),
        (Inner, "a mapping"),
        (Mode, "fast or exact"),
        (Literal["a", 1, None], "a, 1 or null"),
        (float | None, "a number or null"),
        (dict[str, int], "a mapping"),
        (JsonValue, "a value"),
        (ByteSize, "a size such as 2 GiB"),
        (Annotated[ByteSize, Field(ge=2**20)], "a size of at least 1 MiB, such as 2 GiB"),
        (Annotated[int, Field(ge=1)], "an integer of at least 1"),
        (Annotated[float, Field(le=0.5)], "a number of at most 0.5"),
        (Annotated[float, Field(ge=0, le=1)], "a number from 0 to 1"),
        (Annotated[float, Field(gt=0, le=1)], "a number above 0 and at most 1"),
        (Annotated[float, Field(lt=1e-9)], "a number below 1e-09"),
        (Annotated[int, Field(multiple_of=8, ge=8)], "an integer of at least 8, a multiple of 8"),
        (Annotated[str, Field(min_length=1)], "text with at least 1 character"),
        (Annotated[str, Field(min_length=2, max_length=5)], "text with 2 to 5 characters"),
        (Annotated[str, Field(max_length=5)], "text with at most 5 characters"),
        (Annotated[str, Field(pattern="^x+$")], "text that matches ^x+$"),
        (list[int], "a list of integers"),
        (list[int | str], "a list"),
        (tuple[float, float], "a list of 2 numbers"),
        (tuple[int, str], "a list of 2 items"),
        (tuple[Annotated[int, Field(ge=0)], ...], "a list of integers each at least 0"),
        (Annotated[tuple[SpecPath, ...], Field(min_length=2)], "a list of paths with at least 2 items"),
        (list[list[int]], "a list of lists"),
    ],
)
def test_expectation(annotation, words):
    assert wording(annotation) == words


def test_type_and_bounds_apart():
    annotation = Literal["auto"] | Annotated[float, Field(gt=0)]
    assert wording(annotation, type_words) == "auto or number"
    assert wording(annotation, bounds_words) == "above 0"


class Tree(Config):
    children: "tuple[Tree, ...]" = ()


class Elaborate(Config):
    when: int = Field(default_factory=lambda: 4, description="of the day")
    inner: Inner | None = Inner(depth=3)
    many: Inner | Near = Inner()


def test_config_rows_of_computed_defaults_and_unions():
    rows = config_rows(Elaborate)
    assert [(row.key, row.default) for row in rows][:3] == [
        ("when", "computed"),
        ("inner", "{depth: 3}"),
        ("inner.depth", "1"),
    ]
    assert rows[3:5] == (
        ConfigRow("many", "mapping", "{depth: 1}", "", ""),
        ConfigRow("many.depth", "integer", "1", "", "(Inner)"),
    )
    bare = LocatorContribution(name="bare", summary="A toy", config=Elaborate, build=unbuilt)
    section = YAML(typ="safe", pure=True).load(snippet(bare))["locate"]["with"]
    assert section == {"inner": {"depth": 3}, "many": {"depth": 1}}


class Nest(Config):
    inner: "Nest | None" = None


def test_config_rows_of_recursive_config_end():
    tree, nest = config_rows(Tree), config_rows(Nest)
    assert tree[1] == ConfigRow("children[].children", "list of mappings", "[]", "", "")
    assert nest[1] == ConfigRow("inner.inner", "mapping or null", "null", "", "")
    assert len(tree) == len(nest) == 4
