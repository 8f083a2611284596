"""Pipeline specs: YAML with positions, validated models, all problems at once."""
