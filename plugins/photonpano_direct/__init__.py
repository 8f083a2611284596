"""The plugin with photonpano's own locator: direct alignment of photon counts."""
