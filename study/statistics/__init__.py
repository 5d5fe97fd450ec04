"""The study's statistics, from tables of scores: curves, intervals, comparisons, effects."""
