"""The terminal: options, the live display, and Ctrl-C."""
