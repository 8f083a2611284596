"""Sums of frames along a motion: chunks, warps, accumulation."""
