"""A plugin that fails is named with its distribution and the stage, and leaves the run folder as it was."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from photonpano import (
    Config,
    InterpolatorContribution,
    Located,
    LocatorContribution,
    MergerContribution,
    PluginError,
    ResamplerContribution,
    SourceContribution,
    api,
)
from photonpano.registry import Catalog, discover
from photonpano.registry.catalog import make_entry
from photonpano.spec import parse_spec

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


class Fragile:
    """Any component: its method fails."""

    def fails(self, *_: Any) -> Any:
        raise RuntimeError("the cable came loose")

    groups = merge = describe = fit = fails


class FailsToRegister(Fragile):
    def describe(self, exposure: Any) -> None:
        return None

    register = Fragile.fails


class FindsNonsense(FailsToRegister):
    def register(self, moving: Any, fixed: Any, initial: Any) -> Located:
        return Located(np.full((3, 3), np.nan))


class NoConfig(Config):
    pass


def cannot_be_built(*_: Any) -> Any:
    raise RuntimeError("the cable came loose")


UNBUILT = "could not be built: RuntimeError: the cable came loose"
FAILED = "failed at level 1: RuntimeError: the cable came loose"
BROKEN = (
    "broke its contract at level 1: a homography is a finite (3, 3) matrix with h33 = 1, "
    "got [[nan, nan, nan], [nan, nan, nan], [nan, nan, nan]]; a failure is NotLocated"
)
CASES: dict[str, tuple[str, type, Callable[..., Any], str]] = {
    "build source": ("source", SourceContribution, cannot_be_built, UNBUILT),
    "build merger": ("merge", MergerContribution, cannot_be_built, UNBUILT),
    "groups": ("resample", ResamplerContribution, lambda *_: Fragile(), FAILED),
    "merge": ("merge", MergerContribution, lambda *_: Fragile(), FAILED),
    "describe": ("locate", LocatorContribution, lambda *_: Fragile(), FAILED),
    "register": ("locate", LocatorContribution, lambda *_: FailsToRegister(), FAILED),
    "register, NaN": ("locate", LocatorContribution, lambda *_: FindsNonsense(), BROKEN),
    "fit": ("interpolate", InterpolatorContribution, lambda *_: Fragile(), FAILED),
}


@pytest.mark.parametrize(("section", "kind", "build", "message"), CASES.values(), ids=CASES)
def test_it_is_named_and_the_run_folder_stays_as_it_was(
    small_spec: dict[str, Any], tmp_path: Path, section: str, kind: Any, build: Callable[..., Any], message: str
) -> None:
    contribution = kind(name="fragile", summary="Fails", config=NoConfig, build=build)
    entry = make_entry(contribution, "strange-plugin", "1.2", "strange = strange.hooks")
    catalog = Catalog((*discover().rows, entry))
    (tmp_path / "panorama.png").write_text("of an earlier run")
    spec = small_spec | {section: {"use": "fragile"}, "levels": 1}
    with pytest.raises(PluginError) as caught:
        api.run(parse_spec(spec, output=tmp_path, catalog=catalog))
    assert str(caught.value) == f"{contribution.kind} 'fragile' of strange-plugin 1.2 {message}"
    assert [(file.name, file.read_text()) for file in tmp_path.iterdir()] == [("panorama.png", "of an earlier run")]
