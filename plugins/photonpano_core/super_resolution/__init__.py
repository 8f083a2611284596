"""Super-resolution: the flux on a grid finer than the sensor that is most probable, given the photons and a prior."""
