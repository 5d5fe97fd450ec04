"""Results of cells and sweeps, as tables and files."""
