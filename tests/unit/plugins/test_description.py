"""Components in words."""

from pathlib import Path
from textwrap import dedent
from typing import Annotated, Literal

from pydantic import Field
from ruamel.yaml import YAML

from photonpano import Config, LocatorContribution, Requirement, SpecPath
from photonpano.plugins.description import (
    ConfigRow,
    config_rows,
    snippet,
)


class Inner(Config):
    depth: int = 1


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
