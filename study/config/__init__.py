"""What a study is: the paper's numbers, settings, grids and the keys of products."""
