"""What components may return: tables of rules, one for each kind, that runs and the conformance kit share."""
