from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from photonpano import FrameSpan, Group
from photonpano.record.run_json import level_warnings
from photonpano.values import Ambiguity


@pytest.mark.parametrize(
    ("pairs", "others"), [(((1, 0),), ""), (((1, 0), (2, 1)), " and others")], ids=["one pair", "several pairs"]
)
def test_warning_names_the_pairs_that_fit_at_another_place(pairs: Any, others: str) -> None:
    groups = tuple(Group(span, span.centre) for span in (FrameSpan(start, start + 10) for start in (0, 10, 20)))
    located = SimpleNamespace(
        solution=SimpleNamespace(located=np.ones(3, dtype=bool), outliers=()),
        edges=(None,) * 5,
        ambiguity=Ambiguity(1, pairs, 39.7),
    )
    (warning,) = level_warnings([SimpleNamespace(level=SimpleNamespace(number=1), groups=groups, located=located)])
    assert warning == (
        f"level 1: {len(pairs)} of 5 pairs fit the scene as well 40 px away, since it repeats "
        f"(frames 10 to 19 onto frames 0 to 9{others}); the slower motion was taken"
    )
