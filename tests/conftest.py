"""What all tests need."""

import os
import shutil
import signal
from pathlib import Path

pytest_plugins = ("servers", "stores", "running")

# Tests send SIGINT to themselves and to programs that they start. A shell that runs the suite in the background has it
# ignored, and every child would inherit that.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Databases wait for the disk at every commit, and these tests commit by the thousand: their folders lie in memory where
# there is room. What a test must survive is a killed process, which needs no disk.
MEMORY = Path("/dev/shm")  # noqa: S108 - pytest makes a folder of the user's own there
ROOM = 6 << 30  # bytes, of which about 2 GiB are used
if MEMORY.is_dir() and shutil.disk_usage(MEMORY).free >= ROOM:
    os.environ.setdefault("PYTEST_DEBUG_TEMPROOT", str(MEMORY))
