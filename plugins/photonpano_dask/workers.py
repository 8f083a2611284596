"""Workers of a dask cluster."""

from __future__ import annotations

import logging
from concurrent.futures import CancelledError, Future
from contextlib import ExitStack
from typing import Any

import dask
from distributed import Client, LocalCluster
from distributed.cfexecutor import ClientExecutor

from photonpano import ExecutorContext, InputError
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
    # Tasks hold exposures, and the motion of a long capture is tens of megabytes.
    "distributed.admin.large-graph-warning-threshold": "1 TB",
}


def executor_of(config: DaskConfig, context: ExecutorContext) -> DaskExecutor:
    """Connect to a scheduler, or start workers on this machine; raises an `InputError` if there are none."""
    with ExitStack() as stack:
        stack.enter_context(dask.config.set(_SETTINGS_OF_TASKS))
        with dask.config.set(_SETTINGS):
            client = stack.enter_context(_client(config, context.threads, stack))
        threads = sum(client.nthreads().values())
        if not threads:
            raise InputError(
                f"the dask scheduler at {config.address} has no workers; start some with `dask worker {config.address}`"
            )
        ending = stack.pop_all()
    return DaskExecutor(client, _AHEAD * threads, ending)


def _client(config: DaskConfig, threads: int, stack: ExitStack) -> Client:
    if config.address is None:
        number = config.workers or threads
        cluster = LocalCluster(n_workers=number, threads_per_worker=1, dashboard_address=None, silence_logs=logging.CRITICAL)
        return Client(stack.enter_context(cluster), direct_to_workers=True)  # not through the scheduler
    try:
        return Client(config.address, timeout=_PATIENCE_S)
    except (OSError, ValueError) as error:
        raise InputError(
            f"no dask scheduler answers at {config.address} ({error}); start one with `dask scheduler`, and workers with "
            "`dask worker`, or leave out run.executor.with.address"
        ) from error


class DaskExecutor(ClientExecutor):  # type: ignore[misc]  # distributed has no types
    """The executor of a client, which ends with it."""

    def __init__(self, client: Client, under_way: int, ending: ExitStack) -> None:
        """Take the client, how many tasks are worth having under way at once, and what is closed at the end."""
        # Tasks are not pure: a key that is computed from large arguments takes time, and none is submitted twice.
        super().__init__(client, pure=False)
        self.under_way, self._ending = under_way, ending

    def _wrap_future(self, remote: Any) -> Future[Any]:
        # Not the method of distributed, which asks for the state of a task once it has the result: that is an error, or
        # never ends, if the worker was lost in between.
        here: Future[Any] = Future()
        here.add_done_callback(lambda done: remote.cancel() if done.cancelled() else None)

        async def hand_over() -> None:
            try:
                result, error = await remote._result(), None
            except CancelledError:
                here.cancel()
            except Exception as caught:
                result, error = None, caught
            if not here.set_running_or_notify_cancel():
                return
            if error is None:
                here.set_result(result)
            else:
                here.set_exception(error)

        self._client.loop.add_callback(hand_over)
        return here

    def shutdown(self, *_: Any, **__: Any) -> None:
        """Cancel what is under way, and end the processes that were started."""
        super().shutdown(wait=False)
        self._ending.close()
