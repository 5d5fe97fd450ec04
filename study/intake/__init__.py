"""Drives of other writers: examined, adapted to the study, and kept as a folder that a sweep can use."""
