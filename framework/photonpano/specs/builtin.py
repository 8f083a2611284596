"""The framework's own contributions; they enter through the entry point `framework`, as those of plugins do."""
