"""List and describe the components of the installed plugins."""
