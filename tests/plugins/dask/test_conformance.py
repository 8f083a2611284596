"""The component of this plugin keeps what every executor promises."""

from __future__ import annotations

import pytest

from photonpano import discover
from photonpano.testing import ExecutorConformance


@pytest.mark.filterwarnings("default")
class TestDask(ExecutorConformance):
    contribution = discover().find("executor", "dask").contribution
    config = {"workers": 1}
