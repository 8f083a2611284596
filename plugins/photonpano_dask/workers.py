"""Workers of a dask cluster."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from typing import Any

import dask
from distributed import Client, Future, LocalCluster

from photonpano import ExecutorContext, InputError
from photonpano.execution import differences
from photonpano_dask.configs import DaskConfig

_AHEAD = 2  # tasks under way per thread of a worker: the next travels while one is computed
_PATIENCE_S = 10  # how long a scheduler may take to answer
_SETTINGS = {
    "distributed.worker.daemon": True,
    "distributed.comm.timeouts.connect": f"{_PATIENCE_S}s",
    # It would look at the stack of each worker a hundred times a second.
    "distributed.worker.profile.enabled": False,
    # A terminal sends Ctrl-C to workers, too: without them, the tasks that this process waits for would never end.
    "distributed.worker.preload": ["import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)"],
}
_SETTINGS_OF_TASKS = {
    # The motion of a long capture is tens of megabytes: it travels once for many tasks, and again if a worker dies.
    "distributed.admin.large-graph-warning-threshold": "1 TB",
}


def workers_of(config: DaskConfig, context: ExecutorContext) -> DaskWorkers:
    """Connect to a scheduler, or start workers on this machine; raises an `InputError` if none fits this process."""
    cluster: LocalCluster | None = None
    with dask.config.set(_SETTINGS):
        if config.address is None:
            number = config.workers or context.threads
            cluster = LocalCluster(
                n_workers=number, threads_per_worker=1, dashboard_address=None, silence_logs=logging.CRITICAL
            )
            client = Client(cluster)
        else:
            try:
                client = Client(config.address, timeout=_PATIENCE_S)
            except (OSError, ValueError) as error:
                raise InputError(
                    f"no dask scheduler answers at {config.address} ({error}); start one with `dask scheduler`, and workers "
                    "with `dask worker`, or leave out run.executor.with.address"
                ) from error
    workers = DaskWorkers(client, cluster)
    try:
        _require_alike(client, context, config.address)
    except BaseException:
        workers.close()
        raise
    return workers


def _require_alike(client: Client, context: ExecutorContext, address: str | None) -> None:
    there: Mapping[str, Mapping[str, str]] = client.run(context.elsewhere)
    if not there:
        raise InputError(f"the dask scheduler at {address} has no workers; start some with `dask worker {address}`")
    for worker, found in there.items():
        if different := differences(context.here, found):
            raise InputError(
                f"the dask worker {worker} differs from this process: {different}; it needs the same versions, and "
                "must find the same capture at its path, since results must not depend on the worker"
            )


class DaskWorkers:
    """The workers of a dask cluster: see `photonpano.execution.Workers`."""

    def __init__(self, client: Client, cluster: LocalCluster | None = None) -> None:
        """Take the client of the scheduler, and the cluster that ends with it."""
        self._client, self._cluster = client, cluster
        self._settings = ExitStack()
        self._settings.enter_context(dask.config.set(_SETTINGS_OF_TASKS))
        self.under_way = _AHEAD * max(1, sum(client.nthreads().values()))

    def submit(self, function: Callable[..., Any], *given: Any) -> Future:
        """Have a worker call a function: see `Workers`."""
        # Tasks are not pure: a key that is computed from large arguments takes time, and none is submitted twice.
        return self._client.submit(function, *given, pure=False)

    def close(self) -> None:
        """Cancel what is under way, and end the processes that were started."""
        self._client.close()
        if self._cluster is not None:
            self._cluster.close()
        self._settings.close()
