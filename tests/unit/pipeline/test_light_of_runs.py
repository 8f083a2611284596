"""Light that was found is kept if it explains the photons."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from photonpano.pipeline.estimate import _worse_in_light


def look(misfit: float) -> Any:
    """A look whose steps scatter more than any other's."""
    return SimpleNamespace(residuals=SimpleNamespace(misfit=np.full(9, misfit)), worse_than=lambda _: "the scatter grew")


@pytest.mark.parametrize(("misfit", "worse"), [(1.5, ""), (2.9, "the scatter grew")])
def test_scatter_of_steps_counts_only_if_light_does_not_lower_misfit(misfit: float, worse: str) -> None:
    assert _worse_in_light(look(misfit), look(3.0)) == worse
