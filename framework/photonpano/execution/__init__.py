"""Executors: where the tasks of a run are worked on, in threads of this process, or elsewhere."""

from photonpano.execution.here import Here
from photonpano.execution.protocol import Executor

__all__ = ["Executor", "Here"]
