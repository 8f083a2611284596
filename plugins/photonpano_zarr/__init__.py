"""Captures in zarr arrays."""
