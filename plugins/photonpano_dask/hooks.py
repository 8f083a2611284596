"""Hooks of the plugin."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor

from photonpano import ExecutorContext, ExecutorContribution, Requirement, hookimpl
from photonpano_dask.configs import DaskConfig


@hookimpl
def photonpano_executors() -> Iterator[ExecutorContribution]:
    """Offer the workers of dask."""
    yield ExecutorContribution(
        name="dask",
        summary="Workers of a dask cluster, or processes of this machine",
        config=DaskConfig,
        build=_build,
        requires=(Requirement("distributed", "photonpano[dask]"),),
    )


def _build(config: DaskConfig, context: ExecutorContext) -> Executor:
    from photonpano_dask.workers import executor_of

    return executor_of(config, context)
