from __future__ import annotations

import io
import math
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, Group, Located, NotLocated, Panorama
from photonpano.motion.diagnosis import Contrast
from photonpano.motion.registration import Registered
from photonpano.motion.tracking import Place
from photonpano.pipeline.checkpoints.records import digest, packed, unpacked
from photonpano.values import Decision, Edge

RNG = np.random.default_rng(0)


def located(evidence: Any = None) -> Located:
    return Located(RNG.random((3, 3)), RNG.random((8, 8)), 0.1 + 0.2, {} if evidence is None else evidence)


def read_back(value: Any) -> Any:
    stream = io.BytesIO()
    np.savez(stream, **packed(value))
    stream.seek(0)
    with np.load(stream, allow_pickle=False) as archive:
        return unpacked(dict(archive))


def require_same(first: Any, second: Any) -> None:
    """Compare to the last bit: the packed form holds everything."""
    one, other = packed(first), packed(second)
    assert one.keys() == other.keys()
    for name in one:
        assert one[name].dtype == other[name].dtype
        assert one[name].tobytes() == other[name].tobytes()


@pytest.mark.parametrize(
    "value",
    [
        None,
        (1, 2.5, "µ", True, math.inf, -0.0, 5e-324, 2**70),
        {"a": 1, (0, 1): 2.0},
        Edge(4, 3, located({"matches": 12, "share": 0.1}), "direct"),
        Edge(4, 3, NotLocated("too little overlap", {"overlap": math.nan})),
        Registered((Edge(1, 0, located(), "direct"),), Contrast(3.2), Place(0, RNG.random((3, 3)), RNG.random(2)), {0: 12.5}),
        Registered((), Contrast(0.0, "no pixel was seen"), None, {}),
        Panorama(RNG.random((80, 90)).astype(np.float32), np.zeros((80, 90), np.float32), np.eye(3)),
        Decision("group_size", 50, "as it is"),
        FrameSpan(3, 9),
    ],
    ids=lambda value: type(value).__name__,
)
def test_value_comes_back_to_the_last_bit(value: Any) -> None:
    require_same(read_back(value), value)


@pytest.mark.parametrize(
    "array", [np.zeros((0, 3)), np.float32([[1, np.nan]]), np.arange(9000), np.array(True), np.ones((5, 4)).T]
)
def test_array_keeps_type_shape_and_values(array: np.ndarray) -> None:
    found = read_back((array, "x", array))[0]
    assert found.dtype == array.dtype
    np.testing.assert_array_equal(found, array, strict=True)


def test_numbers_of_plugins_become_plain_ones() -> None:
    found = read_back(NotLocated("dark", {"a": np.float32(0.1), "b": np.int64(3), "c": Fraction(1, 4), "d": np.bool_(True)}))
    assert found.evidence == {"a": float(np.float32(0.1)), "b": 3, "c": 0.25, "d": True}


@pytest.mark.parametrize("value", [{1, 2}, np.array([None]), np.array([1j]), 1j, Path("/"), np.array(["text"])])
def test_anything_else_cannot_be_kept(value: Any) -> None:
    with pytest.raises(TypeError, match="cannot be kept"):
        packed(value)


def test_digest_depends_on_every_value() -> None:
    groups = (Group(FrameSpan(0, 10), 4.5), Group(FrameSpan(10, 20), 14.5))
    homographies = RNG.random((500, 3, 3))
    changed = homographies.copy()
    changed[400, 2, 1] = np.nextafter(changed[400, 2, 1], 1)
    given = [
        (groups, homographies),
        (groups[:1], homographies),
        (groups, changed),
        (groups, homographies.reshape(-1, 3)),
        (groups, homographies.astype(np.float32)),
        (groups, None),
        (homographies, groups),
    ]
    assert len({digest(*values) for values in given}) == len(given)
    assert digest(*given[0]) == digest(groups, homographies.copy())
