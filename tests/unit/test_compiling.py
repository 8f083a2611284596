from __future__ import annotations

import numpy as np

from photonpano.compiling import _jit, told_once


def test_what_is_compiled_is_told_once() -> None:
    @_jit(cache=False)
    def twice(values: np.ndarray) -> np.ndarray:
        return values * 2

    told: list[str] = []
    with told_once(lambda: told.append("compiling")):
        twice(np.ones(2))
        twice(np.ones(2, dtype=np.float32))
        assert told == ["compiling"]
    with told_once(lambda: told.append("again")):
        assert twice(np.ones(2)).tolist() == [2, 2]
    twice(np.ones(2, dtype=np.int64))
    assert told == ["compiling"]
