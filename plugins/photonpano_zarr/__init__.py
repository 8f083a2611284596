"""Captures in zarr arrays, and panoramas as OME-Zarr."""
