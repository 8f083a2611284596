"""Warnings of frames that are copies."""

from pathlib import Path

import numpy as np
import pytest

from photonpano.motion.timeline import Timeline
from photonpano.record.run_warnings import timeline_warnings


@pytest.mark.parametrize(("every", "n_copies"), [(2, "1,000"), (3, "666"), (10, None)])
def test_many_copies_are_a_warning(every: int, n_copies: str | None) -> None:
    timeline = Timeline.with_repeats(np.arange(2000) % every == every - 1)
    warnings = timeline_warnings(timeline, Path("run"))
    begins = [] if n_copies is None else [f"{n_copies} of 2,000 frames are copies of the frame before"]
    assert [each.partition(":")[0] for each in warnings] == begins
    assert timeline_warnings(Timeline.regular(2000), Path("run")) == timeline_warnings(None, Path("run")) == []
