"""What all tests need."""

import signal

pytest_plugins = ("servers", "stores")

# Tests send SIGINT to themselves and to programs that they start. A shell that runs the suite in the background has it
# ignored, and every child would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
