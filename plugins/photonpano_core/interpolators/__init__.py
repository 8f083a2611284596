"""Interpolators, and the trajectories that they fit."""
