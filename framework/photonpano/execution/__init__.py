"""Executors: where the tasks of a run are worked on, in threads of this process, or elsewhere."""

from photonpano.execution.executor import CaptureElsewhere, Executor, LocalExecutor, Pending, Remote, Workers, differences

__all__ = ["CaptureElsewhere", "Executor", "LocalExecutor", "Pending", "Remote", "Workers", "differences"]
