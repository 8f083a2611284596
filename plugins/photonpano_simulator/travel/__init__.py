"""A camera that travels through a scene with depth: textured rectangles in space, and the truth about them."""
