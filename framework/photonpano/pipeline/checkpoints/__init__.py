"""Checkpoints: what a run has found is kept in a work folder, so that it can go on after an interruption."""
