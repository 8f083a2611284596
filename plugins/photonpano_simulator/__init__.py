"""Scenes, camera paths and single-photon cameras that are simulated."""
