"""Mergers: the flux of a group of frames along its motion."""
