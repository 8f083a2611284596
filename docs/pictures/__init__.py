"""The pictures of the README and of the docs, one module for the captures and runs that some have in common."""
