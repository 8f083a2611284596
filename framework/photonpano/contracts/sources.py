"""What sources may give: their properties, and the arrays of a span."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from photonpano.contracts.rules import Contract, Rule, is_real, shown
from photonpano.values import Bayer, BoolArray, FluxImage, Response, StreamInfo

_FLUX = np.array([[0.0, 0.01, 0.3], [0.3, 0.01, np.nan]], np.float32)  # with which a response is tried


class Asked(NamedTuple):
    """What a method of a source was asked for: its name, the shape of the array, and the highest value of a pixel."""

    what: str
    shape: tuple[int, ...]
    highest: int = 0


def _whole(name: str) -> Rule:
    def wrong(info: StreamInfo, _: None) -> object:
        size: Any = getattr(info, name)
        return not (isinstance(size, int | np.integer) and size >= 1) and (size,)

    return f"info.{name} is a whole number of at least 1, got {{!r:.60}}", wrong


def _no_rate(info: StreamInfo, _: None) -> object:
    rate: Any = info.frame_rate_hz
    return rate is not None and not (isinstance(rate, int | float | np.number) and 0 < rate < np.inf) and (rate,)


INFO: Contract[StreamInfo] = Contract(
    [
        ("info is a StreamInfo, got {}", lambda info, _: not isinstance(info, StreamInfo) and (shown(info),)),
        *map(_whole, ("n_frames", "height", "width", "bit_depth")),
        (
            "info.kind is binary or intensity, got {!r:.60}",
            lambda info, _: info.kind not in ("binary", "intensity") and (info.kind,),
        ),
        (
            f"info.bayer is {', '.join(get_args(Bayer))} or None, got {{!r:.60}}",
            lambda info, _: info.bayer not in (None, *get_args(Bayer)) and (info.bayer,),
        ),
        ("info.frame_rate_hz is a finite number above 0, or None if it is not known; got {!r:.60}", _no_rate),
    ]
)

# Facts: (height, width) of a frame.
VALID: Contract[BoolArray] = Contract(
    [
        (
            "valid is {} of bool, got {}",
            lambda valid, shape: not (is_real(valid, "b") and valid.shape == shape) and (shape, shown(valid)),
        )
    ]
)


def _tried(response: Response) -> Iterator[tuple[str, Any]]:
    """Yield what the methods of a response make of a few values, NaN among them."""
    with np.errstate(all="ignore"):
        counts = response.mean_count(_FLUX)
        yield "mean_count", counts
        yield "flux", response.flux(counts, 10_000.0)
        yield "stabilised", response.stabilised(_FLUX, np.full(_FLUX.shape, 100, np.float32))
        response.stabilised_std(100.0)


def _no_image(response: Response, _: None) -> object:
    for name, found in _tried(response):
        if not (is_real(found, "f") and found.shape == _FLUX.shape):
            return name, _FLUX.shape, _FLUX.shape, shown(found)
    return None


def _other_nan(response: Response, _: None) -> object:
    tried = ((name, found) for name, found in _tried(response) if (np.isnan(found) != np.isnan(_FLUX)).any())
    return next(((name, _FLUX.tolist(), found.tolist()) for name, found in tried), None)


def _no_inverse(response: Response, _: None) -> object:
    flux = dict(_tried(response))["flux"]
    return not np.allclose(flux, _FLUX, rtol=0.1, atol=0.01, equal_nan=True) and (_FLUX.tolist(), flux.tolist())


RESPONSE: Contract[Response] = Contract(
    [
        ("response.{}() of {} returns {} of float32, got {}", _no_image),
        ("response.{}() keeps NaN, and gives no other; {} became {}", _other_nan),
        ("response.flux() inverts response.mean_count(); {} became {}", _no_inverse),
    ]
)


def _no_integers(found: object, asked: Asked) -> object:
    if is_real(found, "uib"):
        return None
    return asked.what, f"an array of {found.dtype}" if isinstance(found, np.ndarray) else f"a {type(found).__name__}"


def _out_of_range(found: NDArray[Any], asked: Asked) -> object:
    lowest = int(found.min()) if found.dtype.kind == "i" else 0
    highest = int(found.max())
    return (lowest < 0 or highest > asked.highest) and (asked.what, asked.highest, lowest if lowest < 0 else highest)


def _not_finite(found: FluxImage, asked: Asked) -> object:
    number = found.size - int(np.count_nonzero(np.isfinite(found)))
    return number > 0 and (asked.what, number, found.size)


# Facts of the following three: what was asked for.
READ: Contract[NDArray[Any]] = Contract(
    [
        (
            "expected the shape {}, got {}",
            lambda found, asked: np.shape(found) != asked.shape and (asked.shape, np.shape(found)),
        ),
        ("{}() returns an array of whole numbers, got {}", _no_integers),
    ]
)
RANGE: Contract[NDArray[Any]] = Contract(
    [("{}() returns numbers from 0 to {} for these frames, got {}", _out_of_range)],
)
IMAGE: Contract[FluxImage] = Contract(
    [
        (
            "{}() returns {} of float32, got {}",
            lambda found, asked: (
                not (is_real(found, "f") and found.shape == asked.shape) and (asked.what, asked.shape, shown(found))
            ),
        ),
        ("{}() returns finite numbers, masked pixels included; {} of {} pixels are NaN or infinite", _not_finite),
    ]
)
TRUTH: Contract[Mapping[str, NDArray[np.generic]]] = Contract(
    [
        (
            "truth() returns a mapping of arrays by name, got {}",
            lambda found, _: not isinstance(found, Mapping) and (shown(found),),
        )
    ]
)
