"""Executors: where the tasks of a run are worked on, in threads of this process, or elsewhere."""

from photonpano.execution.here import Here
from photonpano.execution.protocol import Executor
from photonpano.execution.remote import CaptureElsewhere, Pending, Remote, Workers, differences

__all__ = ["CaptureElsewhere", "Executor", "Here", "Pending", "Remote", "Workers", "differences"]
