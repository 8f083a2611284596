"""Components are built from a plan; forecasts, and what renderers on planes refuse."""

from typing import Any

import numpy as np
import pytest

from photonpano import (
    Config,
    InterpolatorContribution,
    LocatorContribution,
    MergerContribution,
    PluginError,
    RendererContribution,
    Requirement,
    ResamplerContribution,
    SourceContext,
    SourceContribution,
    StageContext,
    StreamInfo,
)
from photonpano.contracts.attribution import label_of
from photonpano.execution.context import Quiet
from photonpano.photometry import BinaryResponse
from photonpano.pipeline.components import build_levels, build_source, scale_of
from photonpano.pipeline.forecast import TRIAL_GROUPS, forecast
from photonpano.pipeline.rendering import build_renderer
from photonpano.plugins.registry import Catalog, Origin, make_entry
from photonpano.specs import Plan, parse_spec


class Keys(Config):
    size: int = 1


class Built:
    """Remembers what it was built from; stands in for any component."""

    def __init__(self, config: Keys, context: Any) -> None:
        self.config, self.context = config, context
        self.info, self.response = StreamInfo(100, 8, 16, None), BinaryResponse()
        self.valid = np.ones((8, 16), np.bool_)

    def nothing(self, *_: Any) -> None: ...

    counts = frames = close = groups = merge = describe = register = fit = refine = render = nothing


KINDS: list[Any] = [
    SourceContribution,
    ResamplerContribution,
    MergerContribution,
    LocatorContribution,
    InterpolatorContribution,
    RendererContribution,
]
SECTIONS = ("source", "resample", "merge", "locate", "interpolate", "render")


def plan(levels: Any = 1, **changes: Any) -> Plan:
    """Resolve a spec of toys of the distribution `toys`; a change gives other fields to the toy of a kind."""
    rows = []
    for kind in KINDS:
        fields = {"name": "toy", "summary": "A toy", "config": Keys, "build": Built} | changes.get(kind.kind, {})
        rows.append(make_entry(kind(**fields), Origin("toys", "1.0", "toys = toys.hooks")))
    spec = {"version": 1, **{section: {"use": "toy"} for section in SECTIONS}, "levels": levels}
    return parse_spec(spec | {"run": {"seed": 7, "threads": 3}}, catalog=Catalog(tuple(rows)))


def test_components_receive_their_config_and_context() -> None:
    made = plan()
    source = build_source(made)
    assert source.source.given.context == SourceContext(seed=7, threads=3)
    (level,) = build_levels(made, source, [])
    assert level.locators[0].component.context == StageContext(source.info, source.response, seed=7, threads=3)
    for stage in (level.resampler, level.merger, level.interpolator):
        assert stage.context.response == source.response
    assert label_of(level.locators[0].component) == "locator 'toy' of toys 1.0"
    assert [label_of(each) for each in (level.resampler, level.merger, level.interpolator)] == [
        f"{kind} 'toy' of toys 1.0" for kind in ("resampler", "merger", "interpolator")
    ]


def broken(*_: Any) -> Any:
    raise RuntimeError("no such device")


def build_all(made: Plan) -> None:
    source = build_source(made)
    build_levels(made, source, [])
    build_renderer(made, source, [])


@pytest.mark.parametrize("kind", [kind.kind for kind in KINDS])
def test_component_that_cannot_be_built_is_named(kind: str) -> None:
    made = plan(**{kind: {"build": broken}})
    with pytest.raises(PluginError) as caught:
        build_all(made)
    assert str(caught.value) == f"{kind} 'toy' of toys 1.0 could not be built: RuntimeError: no such device"


def test_missing_library_is_named_with_its_install_line() -> None:
    """A spec that was checked elsewhere, or a library that was uninstalled since."""
    made = plan()
    contribution = made.source.contribution
    object.__setattr__(contribution, "requires", (Requirement("no_such_library", "photonpano[camera]"),))
    with pytest.raises(PluginError) as caught:
        build_source(made)
    assert str(caught.value) == (
        "source 'toy' of toys 1.0 needs no_such_library, which is not installed: "
        'pip install "photonpano[camera]" (in a checkout: pip install ".[camera]")'
    )


@pytest.mark.parametrize(
    ("levels", "shape", "scales"),
    [
        (1, (254, 496), [1]),
        (2, (254, 496), [0.5, 1]),
        (4, (254, 496), [0.5, 0.5, 1, 1]),
        (3, (191, 496), [1, 1, 1]),
        ([{"scale": 2}, {}, {}], (254, 496), [2, 0.5, 1]),
    ],
)
def test_auto_scale_halves_the_first_two_levels_if_a_later_one_refines_them(
    levels: Any, shape: tuple[int, int], scales: list[float]
) -> None:
    plan = parse_spec({"version": 1, "source": {"use": "simulator"}, "levels": levels})
    assert [scale_of(plan, number, shape) for number in range(1, len(scales) + 1)] == scales


def test_forecast_predicts_time_memory_and_canvas(small_spec: dict[str, Any]) -> None:
    plan = parse_spec(small_spec | {"resample": {"with": {"group_size": 20}}, "levels": 2})
    with build_source(plan) as source:
        found = forecast(plan, source, Quiet())
        n_frames = source.info.n_frames
    assert len(found.tried) == 20 * TRIAL_GROUPS < n_frames
    assert abs(found.tried.centre - (n_frames - 1) / 2) <= 1
    assert set(found.seconds) == {"level 1", "level 2", "corrections", "residuals", "panorama"}
    assert min(found.seconds.values()) > 0
    assert found.memory_bytes > 30 * 2**20
    # The camera pans by 60 px over the capture, and trembles.
    assert 190 < found.canvas[1] < 290
    assert 128 <= found.canvas[0] < 220
