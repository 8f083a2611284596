"""The loop of the paper, the motion graph, the panorama, and the run folder."""
