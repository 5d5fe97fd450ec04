"""The multi-head autoencoder (Sec. III-B, IV-B) and its training."""
