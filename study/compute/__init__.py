"""The machine that the work runs on: devices, precision, the Lightning trainer, provenance."""
