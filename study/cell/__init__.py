"""The main path of one cell and the stages on it."""
