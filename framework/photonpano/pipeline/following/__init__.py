"""Follow a capture that is still being written: locate its frames as they arrive, and show the picture so far."""
