"""Runs on clusters, with dask.distributed."""
