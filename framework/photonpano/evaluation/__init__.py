"""Scores of trajectories and panoramas against a known truth."""
