"""What components must have and may return, and whose errors name them: shared by runs and the conformance kit."""
