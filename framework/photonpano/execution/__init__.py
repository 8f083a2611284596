"""How a computation runs: progress and checkpoints, and threads or another executor that work on its tasks."""
