from __future__ import annotations

import pytest

from photonpano import Config, ExecutorContribution, LocationError
from photonpano.execution import LocalExecutor
from photonpano.testing import ExecutorConformance
from photonpano.testing.executors import N_FRAMES, capture


class NoConfig(Config):
    pass


class Forgetful(LocalExecutor):
    """Keeps nothing."""

    def keep(self, work, *given):
        return None, work(*given)[1]


class Mute(LocalExecutor):
    """Swallows errors."""

    def call(self, work, *given):
        try:
            return work(*given)
        except LocationError:
            return None


class Stale(LocalExecutor):
    """Reads another capture."""

    def call(self, work, *given):
        done = work(*given)
        return done + 1 if given and given[0] is capture() else done


class Unordered(LocalExecutor):
    """Takes the last item for all."""

    def call(self, work, *given):
        return super().call(work, *((given[0], 19) if isinstance(given[0], dict) else given))


@pytest.mark.parametrize(
    ("broken", "check"),
    [
        (Forgetful, "test_kept_results_are_given_to_other_tasks"),
        (Mute, "test_error_of_a_task_arrives"),
        (Stale, "test_task_sees_the_capture"),
        (Unordered, "test_shared_values_are_given_to_many_tasks"),
    ],
)
def test_broken_executor_is_found(broken: type[LocalExecutor], check: str) -> None:
    class Checks(ExecutorConformance):
        contribution = ExecutorContribution(
            name="broken", summary="Breaks a promise", config=NoConfig, build=lambda _, context: broken(context.threads)
        )

    getattr(Checks(), check)(LocalExecutor(2))
    with pytest.raises((AssertionError, TypeError, pytest.fail.Exception)):
        getattr(Checks(), check)(broken(2))
    assert capture().info.n_frames == N_FRAMES
