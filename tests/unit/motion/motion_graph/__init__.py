"""The motion graph: its solution, how certain that is, and the equations beneath."""
