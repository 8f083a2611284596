"""Sources of captures in the formats of cameras and their programs."""
