"""A locator made of COLMAP's parts: its features, its matcher and its LO-RANSAC."""
