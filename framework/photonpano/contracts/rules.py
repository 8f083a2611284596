"""State what a component may return as a table of rules, check values against it, and name the component that broke one."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Generic, TypeAlias, TypeVar

import numpy as np

from photonpano.errors import PhotonpanoError, PluginError, described

T = TypeVar("T")
# What is required, as a sentence for users, and a check of a value against facts, such as the number of frames of the capture.
# The check returns what to put into the placeholders of the sentence if the rule is broken, and something false if it holds.
Rule: TypeAlias = tuple[str, Callable[[Any, Any], object]]


class BrokenContract(Exception):  # noqa: N818 - it is not raised to callers
    """What a component returned although its protocol does not allow it, as a clause; raised inside `attributing`."""


@contextmanager
def attributing(origin: str, where: str) -> Iterator[None]:
    """Raise a `PluginError` that names a component for errors of the block.

    Errors that are written for users pass unchanged.

    Args:
        origin: who provides the component, such as "merger 'photon-mle' of photonpano 0.1.0".
        where: what it works on, such as "level 2" or "frames 0 to 15".
    """
    try:
        yield
    except PhotonpanoError:
        raise
    except BrokenContract as error:
        raise PluginError(f"{origin} broke its contract at {where}: {error}") from None
    except Exception as error:
        raise PluginError(f"{origin} failed at {where}: {described(error)}") from error


class Contract(Generic[T]):
    """The rules for what one kind of component returns: `rules` for runs, each of which may rely on those before it.

    `strict` are those of the conformance kit alone: a run converts such a value, or can do without it.
    """

    def __init__(self, rules: Sequence[Rule], strict: Sequence[Rule] = ()) -> None:
        self.rules = tuple(rules)
        self.strict = tuple(strict)

    def require(self, found: Any, facts: Any = None) -> T:
        """Return a value that keeps the rules of a run, or raise `BrokenContract` with the sentence of the first broken one."""
        for sentence, check in self.rules:
            if wrong := check(found, facts):
                raise BrokenContract(_filled(sentence, wrong))
        value: T = found
        return value

    def first_broken(self, found: object, facts: Any = None) -> tuple[Rule, str] | None:
        """Return the first rule that a value breaks, strict ones included, and its sentence; None if it keeps all."""
        for rule in (*self.rules, *self.strict):
            sentence, check = rule
            if wrong := check(found, facts):
                return rule, _filled(sentence, wrong)
        return None


def _filled(sentence: str, wrong: object) -> str:
    return sentence.format(*wrong) if isinstance(wrong, tuple) else sentence


def shown(value: object) -> str:
    """Describe a value by its type, and an array by its shape and type."""
    return f"{value.shape} of {value.dtype}" if isinstance(value, np.ndarray) else f"a {type(value).__name__}"


def is_real(array: object, kinds: str = "fiu") -> bool:
    """Return whether a value is an array of real numbers, or of other kinds of numbers (see `numpy.dtype.kind`)."""
    return isinstance(array, np.ndarray) and array.dtype.kind in kinds


def instance(expected: str, *kinds: type) -> Rule:
    """Require an instance of one of some classes."""
    return f"expected {expected}, got {{}}", lambda found, _: not isinstance(found, kinds) and (type(found).__name__,)


def text(name: str, label: str) -> Rule:
    """Require an attribute that is a text."""
    return (
        f"{label} is a text, got {{}}",
        lambda found, _: not isinstance(value := getattr(found, name), str) and (shown(value),),
    )


def float64(name: str, shape: Callable[[Any, Any], tuple[int, ...]]) -> Rule:
    """Require an attribute that is an array of float64 of a shape, which may depend on the value and on the facts."""
    return (
        f"expected {name} as float64 of the shape {{}}, got {{}}",
        lambda found, facts: not_float64(getattr(found, name), shape(found, facts)),
    )


def not_float64(array: object, shape: tuple[int, ...]) -> tuple[object, ...]:
    """Return the wanted shape and what there is instead; nothing if a value is an array of float64 of this shape."""
    right = isinstance(array, np.ndarray) and array.dtype == np.float64 and array.shape == shape
    return () if right else (shape, shown(array))


def is_float64(name: str) -> Rule:
    """Require an attribute of double precision, as all geometry."""
    return (
        f"{name} must be float64, as all geometry; got {{}}",
        lambda found, _: getattr(found, name).dtype != np.float64 and (getattr(found, name).dtype,),
    )


def has_h33_of_1(homographies: Callable[[Any], Any]) -> Rule:
    """Require homographies (..., 3, 3) that are scaled so that h33 = 1."""

    def check(found: object, _: object) -> object:
        h33 = homographies(found)[..., 2, 2]
        return (np.abs(h33 - 1) >= 1e-9).any() and (h33.flat[np.abs(h33 - 1).argmax()],)

    return "a homography must have h33 = 1, got {:.6g}: divide by it", check


def images(shape: Callable[[Any], tuple[int, ...]]) -> tuple[Rule, Rule, Rule]:
    """Require `flux` and `weight` of a shape: flux is finite exactly where the weight is positive, and NaN elsewhere."""

    def image(name: str) -> Rule:
        def check(found: object, facts: object) -> object:
            array, wanted = getattr(found, name), shape(facts)
            return not (is_real(array, "f") and array.shape == wanted) and (wanted, shown(array))

        return f"{name} is {{}} of float32, got {{}}", check

    finite = (
        "flux is finite where weight is positive, and NaN where weight is 0; at row {}, column {} flux is {:g} and weight {:g}"
    )
    return image("flux"), image("weight"), (finite, _unknown_where_seen)


# A run converts images to float32, and does without the sign of flux.
STRICT_IMAGES: tuple[Rule, ...] = (
    ("flux must be float32, got {}", lambda found, _: found.flux.dtype != np.float32 and (found.flux.dtype,)),
    ("weight must be float32, got {}", lambda found, _: found.weight.dtype != np.float32 and (found.weight.dtype,)),
    ("flux must not be negative, got {:.3g}", lambda found, _: (low := np.nanmin(found.flux, initial=0)) < 0 and (low,)),
)


def _unknown_where_seen(found: Any, _: object) -> object:
    flux, weight = np.asarray(found.flux, np.float32), np.asarray(found.weight, np.float32)
    finite, lowest = np.isfinite(flux), weight.min()
    bounded = 0 <= lowest <= weight.max() < np.inf
    if bounded and lowest > 0 and finite.all():
        return None
    seen = weight > 0
    if bounded and not (finite != seen).any() and np.isnan(flux[~seen]).all():
        return None
    row, column = np.argwhere((finite != seen) | np.isinf(flux) | ~(weight >= 0) | ~np.isfinite(weight))[0]
    return row, column, flux[row, column], weight[row, column]
