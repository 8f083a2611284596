"""What is tried after the first level of the loop: see `rule.Pass`."""
