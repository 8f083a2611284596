"""Locator built on COLMAP."""
