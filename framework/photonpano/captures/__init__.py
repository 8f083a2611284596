"""What looks at a capture: its summary, copies of it, pictures of it."""
