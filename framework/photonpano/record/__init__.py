"""What a run leaves as files: `run.json` and its schema, fingerprints of captures, and pictures."""
