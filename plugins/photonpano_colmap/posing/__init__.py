"""Poses of a camera that moves through a scene, from exposures that are merged through its depth."""
