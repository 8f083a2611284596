"""Residuals of the photons against the panorama, refinement of the motion, and the verdict on a run."""
