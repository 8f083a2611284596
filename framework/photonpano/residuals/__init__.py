"""What the panorama does not explain: residuals of the photons, refinement of the motion, and the verdict on a run."""
