"""Statistics, claims and confounds: pure functions of result tables."""
