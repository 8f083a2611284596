"""Components are built from a plan; forecasts, and what renderers on planes refuse."""

from typing import Any, cast

import numpy as np
import pytest

from photonpano import (
    Config,
    FrameSpan,
    Group,
    InputError,
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
from photonpano.capture import in_light, seen_through
from photonpano.contracts.attribution import attributed, label_of
from photonpano.contracts.protocols import Renderer
from photonpano.geometry import Camera, Canvas, FrameTrajectory, canvas_around, covered_by, rotation_matrices
from photonpano.photometry import BinaryResponse
from photonpano.pipeline.components import build_levels, build_source, foreseen_groups, scale_of
from photonpano.pipeline.forecast import TRIAL_GROUPS, forecast
from photonpano.pipeline.rendering import ChosenRenderer, build_renderer
from photonpano.plugins.registry import Catalog, Origin, make_entry
from photonpano.specs import Plan, parse_spec
from photonpano.testing import MemorySource
from photonpano.values import Decision, Light


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


class Curious(Built):
    """A resampler that looks at the capture, and chooses something because of it."""

    def groups(self, n_frames: int, level: int) -> tuple[Group, ...]:
        flux = self.context.capture().flux
        self.context.decide("size", self.config.size, f"the flux is {flux:.1f}")
        span = FrameSpan(0, n_frames)
        return (Group(span, span.centre),)


def test_capture_is_summarised_once_on_first_use_and_decisions_are_recorded(memory_source: Any) -> None:
    source = memory_source(np.random.default_rng(0).random((48, 16, 16)) < 0.5)
    looked: list[FrameSpan] = []
    source.counts = lambda span, counts=source.counts: looked.append(span) or counts(span)
    made = plan(levels=[{}, {"resample": {"with": {"size": 2}}}], resampler={"build": Curious})
    decisions: list[Decision] = []
    levels = build_levels(made, source, decisions)
    assert (looked, decisions) == ([], [])
    levels[0].resampler.groups(48, 1)
    once = len(looked)
    levels[1].resampler.groups(48, 2)
    assert len(looked) == once > 0
    assert decisions == [Decision("size", 1, "the flux is 0.7"), Decision("size", 2, "the flux is 0.7")]


def test_decision_that_json_cannot_hold_is_refused() -> None:
    made = plan()
    (level,) = build_levels(made, build_source(made), [])
    with pytest.raises(TypeError, match="number, a text, true or false; size is a list"):
        level.locators[0].component.context.decide("size", [1], "so")


def test_foreseen_groups_reads_no_frames() -> None:
    made = plan(levels=[{}, {"resample": {"with": {"size": 2}}}], resampler={"build": Curious})
    assert foreseen_groups(made, build_source(made)) == ["chosen from flux and speed when the capture is read"] * 2
    with pytest.raises(PluginError, match=r"^resampler 'toy' of toys 1\.0 failed at level 1: TypeError: "):
        foreseen_groups(plan(), build_source(made))


def test_levels_with_the_same_choice_share_a_component() -> None:
    made = plan(levels=[{"scale": 0.5}, {"locate": {"with": {"size": 2}}}, {}])
    first, second, third = build_levels(made, build_source(made), [])
    locators = [level.locators[0].component.component for level in (first, second, third)]
    assert locators[0] is locators[2] is not locators[1]
    assert first.merger.component is second.merger.component is third.merger.component
    assert [level.number for level in (first, second, third)] == [1, 2, 3]
    assert [level.scale for level in (first, second, third)] == [0.5, 1, 1]
    assert locators[1].config == Keys(size=2)


def test_fallbacks_follow_the_locator_in_order_and_share_components() -> None:
    larger = {"use": "toy", "with": {"size": 2}}
    made = plan(
        levels=[
            {"locate": {"fallback": larger}},
            {"locate": larger | {"fallback": ["toy", {"use": "toy", "with": {"size": 3}}]}},
        ]
    )
    first, second = build_levels(made, build_source(made), [])
    assert [(each.name, each.component.config.size) for each in first.locators] == [("toy", 1), ("toy 2", 2)]
    assert [(each.name, each.component.config.size) for each in second.locators] == [("toy", 2), ("toy 2", 1), ("toy 3", 3)]
    assert {label_of(each.component) for each in second.locators} == {"locator 'toy' of toys 1.0"}
    assert first.locators[0].component.component is second.locators[1].component.component
    assert first.locators[1].component.component is second.locators[0].component.component


def broken(*_: Any) -> Any:
    raise RuntimeError("no such device")


def build_all(made: Plan) -> None:
    source = build_source(made)
    build_levels(made, source, [])
    build_renderer(made, source, [])


@pytest.mark.parametrize(("divides", "lit"), [(False, True), (True, True), (False, False)])
def test_renderer_that_ignores_changing_light_is_named(divides: bool, lit: bool, caplog: pytest.LogCaptureFixture) -> None:
    source: Any = MemorySource(np.zeros((4, 8, 16)))
    if lit:
        source = in_light(source, Light.of_frames(np.array([0.5, 1, 1, 1.5])))
    build_renderer(plan(renderer={"divides_by_light": divides}), source, [])
    warning = (
        "renderer 'toy' of toys 1.0 does not divide by the light, which changes: the panorama shows each place in the mean "
        "light of the frames that saw it; render with {use: merge} to divide by it"
    )
    assert caplog.messages == ([warning] if lit and not divides else [])


@pytest.mark.parametrize("kind", [kind.kind for kind in KINDS])
def test_component_that_cannot_be_built_is_named(kind: str) -> None:
    made = plan(**{kind: {"build": broken}})
    with pytest.raises(PluginError) as caught:
        build_all(made)
    assert str(caught.value) == f"{kind} 'toy' of toys 1.0 could not be built: RuntimeError: no such device"


def test_error_for_users_passes_unchanged() -> None:
    def missing(*_: Any) -> Any:
        raise InputError("there is no file cube.npy")

    with pytest.raises(InputError, match=r"^there is no file cube\.npy$"):
        build_source(plan(source={"build": missing}))


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
        found = forecast(plan, source)
        n_frames = source.info.n_frames
    assert len(found.tried) == 20 * TRIAL_GROUPS < n_frames
    assert abs(found.tried.centre - (n_frames - 1) / 2) <= 1
    assert set(found.seconds) == {"level 1", "level 2", "panorama"}
    assert min(found.seconds.values()) > 0
    assert found.memory_bytes > 30 * 2**20
    # The camera pans by 60 px over the capture, and trembles.
    assert 190 < found.canvas[1] < 290
    assert 128 <= found.canvas[0] < 220


@pytest.mark.parametrize(("extent", "shape"), [("reference", (256, 320)), ([-10, 5, 20, 25], (40, 60))])
def test_forecast_of_a_part_has_the_size_of_the_part(small_spec: dict[str, Any], extent: Any, shape: tuple[int, int]) -> None:
    render = {"extent": extent, "scale": 2}
    plan = parse_spec(small_spec | {"resample": {"with": {"group_size": 10}}, "levels": 1, "render": render})
    with build_source(plan) as source:
        assert forecast(plan, source).canvas == shape


def test_forecast_of_a_turn_knows_that_a_sphere_ends() -> None:
    """The trial turns by 90 degrees of 500; all around are 377 px, and a box of degrees is left out of account."""
    scene = {"kind": "street", "width": 400, "height": 200}
    turn = {"scene": scene, "path": {"kind": "turn", "degrees": 500}, "frame_shape": [48, 80], "focal_length_px": 60}
    spec = {
        "version": 1,
        "source": {"use": "simulator", "with": turn | {"n_frames": 1000, "flux": 2.0}},
        "motion": {"model": "rotation"},
        "camera": {"focal_px": 60},
        "resample": {"with": {"group_size": 15}},
        "levels": 1,
        "render": {"projection": "spherical", "extent": [0, -10, 20, 10]},
    }
    plan = parse_spec(spec)
    with build_source(plan) as source:
        height, width = forecast(plan, source).canvas
    assert width == 377
    assert 40 <= height < 60


SHAPE = (40, 60)
CAMERA = Camera.of(50.0, SHAPE)
LENS = Camera.of(50.0, SHAPE, [-0.1, 0, 0, 0])
PLANE = Canvas(*SHAPE, np.eye(3))
SPHERE = canvas_around(covered_by(np.eye(3)[None], CAMERA, SHAPE), CAMERA, 1.0, "spherical")


@pytest.mark.parametrize(
    ("canvas", "camera", "degrees", "reason"),
    [
        (
            SPHERE,
            CAMERA,
            0,
            "renders on a plane only, and this panorama is spherical; write render.use: merge, or render.projection: planar",
        ),
        (PLANE, LENS, 0, "does not render through a lens that distorts; write render.use: merge"),
        (PLANE, CAMERA, 120, "does not leave out frames that reach behind the plane; write render.use: merge"),
    ],
    ids=["sphere", "lens", "behind"],
)
def test_renderer_on_planes_is_not_called_for_other_canvases(
    canvas: Canvas, camera: Camera, degrees: float, reason: str
) -> None:
    turn = FrameTrajectory(CAMERA.homographies(rotation_matrices([[0, 0, 0], [0, np.radians(degrees), 0]])))
    source = seen_through(MemorySource(np.zeros((2, *SHAPE), np.uint8)), camera)
    renderer = ChosenRenderer(
        attributed(cast("Renderer", None), "renderer 'flat' of a plugin", "the panorama"), 40, any_canvas=False
    )
    with pytest.raises(InputError) as caught:
        renderer.render(source, turn, FrameSpan(0, 2), canvas, 0.25, lambda _: None)
    assert str(caught.value) == f"renderer 'flat' of a plugin {reason}"
