"""Tests of the study, one module for each module of it; helpers live in `tests.support`."""
