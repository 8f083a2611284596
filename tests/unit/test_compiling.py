from __future__ import annotations

import numpy as np

from photonpano.compiling import _jit, notify_on_first_compile


def test_notify_on_first_compile_calls_once_per_block_and_only_if_something_is_compiled() -> None:
    @_jit(cache=False)
    def twice(values: np.ndarray) -> np.ndarray:
        return values * 2

    notes: list[str] = []
    with notify_on_first_compile(lambda: notes.append("compiling")):
        twice(np.ones(2))
        twice(np.ones(2, dtype=np.float32))
        assert notes == ["compiling"]
    with notify_on_first_compile(lambda: notes.append("again")):
        assert twice(np.ones(2)).tolist() == [2, 2]
    twice(np.ones(2, dtype=np.int64))
    assert notes == ["compiling"]
