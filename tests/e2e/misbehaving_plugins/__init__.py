"""Plugins that misbehave in every way that was thought of: the right one is named, exit code 1, and no file is written."""
