"""One run, from its beginning to its end: components, passes, executors, checkpoints, observers, and the run folder."""
