"""Discovery of plugins and the catalog of what they contribute."""
