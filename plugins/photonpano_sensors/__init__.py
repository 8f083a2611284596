"""Captures as cameras and their programs write them."""
