"""Locator `direct`: alignment of brightness at the limit of photon noise."""
