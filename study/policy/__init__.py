"""Policies on frozen latents (Sec. IV-C): many seeds trained at once."""
