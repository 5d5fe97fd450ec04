"""Baselines: what policies are given in the place of a trained latent."""
