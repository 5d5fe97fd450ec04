"""The simulated town: what drives, and what is recorded of it (Sec. IV-A)."""
