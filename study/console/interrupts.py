"""Stop a command on Ctrl-C or SIGTERM without losing anything."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable

from study.errors import EXIT_AGAIN, EXIT_INTERRUPTED

EXITS_AT_ONCE = (EXIT_INTERRUPTED, EXIT_AGAIN)
STOP_SECONDS = 2.0  # that a stopped command has to come to an end by itself


def stoppable(work: Callable[[], int], command: str) -> int:
    """Do the work and return its exit code; Ctrl-C, or a batch system's SIGTERM, ends it with how to go on.

    So does the timer of a time limit (SIGALRM), with EXIT_AGAIN.

    A signal does not break into what runs, which may be a library's write: the work asks `check_stopped` now and then.
    Work that does not ask in time is left where it is, as if it had been killed, which every part of a study survives.
    """
    stop = _Stop(command)
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGALRM)
    before = {number: signal.getsignal(number) for number in numbers}
    for number, handler in before.items():
        if handler is not signal.SIG_IGN:  # as nohup and shells leave it for what they start behind
            signal.signal(number, stop.press)
    _stops.append(stop)
    try:
        return work()
    except KeyboardInterrupt:
        stop.leave(at_once=False)
        return stop.code
    finally:
        _stops.remove(stop)
        stop.timer.cancel()
        for number, handler in before.items():
            signal.signal(number, handler)


class _Stop:
    """Remembers that the user wants to stop, and sees to it that this happens soon."""

    def __init__(self, command: str) -> None:
        self.command, self.pressed, self.code = command, False, EXIT_INTERRUPTED
        self.timer = threading.Timer(STOP_SECONDS, self.leave)
        self.timer.daemon = True

    def press(self, number: int, _: object) -> None:
        if not self.pressed:  # a second Ctrl-C changes nothing
            self.pressed = True
            self.code = EXIT_AGAIN if number == signal.SIGALRM else EXIT_INTERRUPTED
            self.timer.start()

    def leave(self, *, at_once: bool = True) -> None:
        """Say how to go on, and end the process when that must be `at_once`."""
        show_cursor = "\x1b[?25h" if sys.stderr.isatty() else ""
        print(f"{show_cursor}\nStopped. Nothing that was finished is lost. To go on: {self.command}", file=sys.stderr)
        if at_once:
            sys.stderr.flush()
            os._exit(self.code)


_stops: list[_Stop] = []


def check_stopped() -> None:
    """Raise KeyboardInterrupt after a Ctrl-C or SIGTERM under `stoppable`."""
    if any(stop.pressed for stop in _stops):
        raise KeyboardInterrupt
