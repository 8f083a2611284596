"""Components around good ones that misbehave, and what a run with one must end with."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from photonpano import (
    Config,
    InterpolatorContribution,
    LocatorContribution,
    MergerContribution,
    RefinerContribution,
    RendererContribution,
    ResamplerContribution,
    SourceContribution,
)
from photonpano.plugins.registry import Origin
from photonpano_poses import PoseEstimatorContribution

ORIGIN = Origin("strange-plugin", "1.2", "strange = strange.hooks")
SHAPE, FRAMES = (48, 64), 160
NOTHING: Any = None  # what a plugin that is not typed gives instead of a text
# The section that chooses a kind, its contribution, and the component that the strange one is built around.
KINDS: Mapping[str, tuple[str, Any, str]] = {
    "source": ("source", SourceContribution, "memory"),
    "resampler": ("resample", ResamplerContribution, "midpoint"),
    "merger": ("merge", MergerContribution, "photon-mle"),
    "locator": ("locate", LocatorContribution, "direct"),
    "interpolator": ("interpolate", InterpolatorContribution, "smoothing-spline"),
    "refiner": ("refine", RefinerContribution, "short-spans"),
    "renderer": ("render", RendererContribution, "merge"),
    "pose-estimator": ("pose", PoseEstimatorContribution, "known-path"),
}


class Keys(Config):
    """No keys."""


class SpeechlessError(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no words")


ERRORS: Mapping[str, tuple[Exception, str]] = {
    "an error": (RuntimeError("the cable came loose"), "RuntimeError: the cable came loose"),
    "no words": (SpeechlessError(), "SpeechlessError: (its message cannot be written)"),
}


class Around:
    """A component around a good one, some of whose attributes are replaced.

    A strange locator offers no `turning`: what that of the good one returns would not misbehave.
    """

    def __init__(self, inner: Any, **changed: Any) -> None:
        self.inner = inner
        self.__dict__.update(changed)

    def __getattr__(self, name: str) -> Any:
        if name == "turning":
            raise AttributeError(name)
        return getattr(self.inner, name)

    def __enter__(self) -> Around:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def around(method: str, change: Callable[..., Any]) -> Callable[[Any], Any]:
    """Return what replaces a method of a good component: `change` gets what the good method returns, and its arguments."""
    return lambda inner: Around(inner, **{method: lambda *all_, **named: change(getattr(inner, method)(*all_, **named), *all_)})


def given(method: str, change: Callable[..., tuple[Any, ...]]) -> Callable[[Any], Any]:
    """Return what replaces a method of a good component: `change` makes of its arguments those that the good method gets."""
    return lambda inner: Around(
        inner, **{method: lambda *all_, **named: getattr(inner, method)(*change(*all_, *named.values()))}
    )


def instead(method: str, answer: Callable[..., Any]) -> Callable[[Any], Any]:
    """Return what replaces a method of a good component by a function."""
    return lambda inner: Around(inner, **{method: answer})


def raising(error: BaseException) -> Callable[..., Any]:
    def fail(*_: Any, **__: Any) -> Any:
        raise error

    return fail


def holed(image: np.ndarray, value: float) -> np.ndarray:
    image = image.copy()
    image[3, 5] = value
    return image


@dataclass(frozen=True)
class Outcome:
    """What the command `run` ends with: its exit code, what it prints, and the files of the run folder that it wrote."""

    code: int
    printed: str
    files: Sequence[str]
    record: Mapping[str, Any] | None


def require_named(outcome: Outcome, kind: str, message: str) -> None:
    """Require that a run failed, wrote nothing, and that its message names the plugin."""
    label = f"{kind} 'strange' of strange-plugin 1.2"
    assert outcome.printed.startswith(f"error: {label} {message}"), outcome.printed
    assert "Traceback" not in outcome.printed
    assert (outcome.code, outcome.files) == (1, [])
