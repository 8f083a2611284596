"""Locators built on kornia and torch."""
