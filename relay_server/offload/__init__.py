"""Functions that run on workers for users and robots."""
