"""The commands that run a sweep, look at it, and check it."""
