"""Refiners: a trajectory made finer after the loop."""
