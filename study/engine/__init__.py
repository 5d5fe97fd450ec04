"""Engines run the tasks of a study: in this process, on this machine's cores, or on a cluster of machines."""
