"""Locators built on OpenCV."""
