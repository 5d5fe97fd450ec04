"""Figures: drawn from plain arrays and tables, by matplotlib alone."""
