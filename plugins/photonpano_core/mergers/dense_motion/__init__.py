"""Motion beyond the global one: a dense field for each group, and what contradicts the global motion."""
