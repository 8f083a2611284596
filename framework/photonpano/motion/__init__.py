"""The paper: the loop that estimates the motion of a capture, and each of its four steps."""
