"""Metrics, claims with their rules, and confounds: pure functions of result tables."""
