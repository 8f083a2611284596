"""Run folders: written whole or not at all, and never in place of what is not theirs."""
