"""One spec run on many captures: each in a process of its own, and one summary of all."""
