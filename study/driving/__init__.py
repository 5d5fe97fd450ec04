"""A policy at the wheel: encoder and policy joined to one network."""
