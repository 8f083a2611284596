"""The record of a run, `run.json`: its schema, and what writes and reads it."""
