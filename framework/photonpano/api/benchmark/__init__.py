"""A fixed set of captures on which programs are compared."""
