"""Components that misbehave in every way that was thought of: what the conformance kit says of them, and how a run ends."""
