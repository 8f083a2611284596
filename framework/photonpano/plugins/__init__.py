"""What plugins offer and how they are found: contributions, hooks, and the catalog of the plugins installed."""
