"""An ablation-study harness: which decoder heads make a driving latent worth learning from."""
