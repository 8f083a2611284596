"""Files and folders: whole or not at all, locked, and named by paths or addresses."""
