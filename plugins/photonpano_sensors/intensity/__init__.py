"""Captures of conventional high-speed cameras: grey levels instead of single photons."""
