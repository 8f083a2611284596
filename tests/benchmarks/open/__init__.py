"""The open benchmark: a fixed set of captures, on which any program is scored."""
