"""What the commands share: options made from the settings, clear errors, exit codes."""

from __future__ import annotations

import argparse
import difflib
import errno
import os
import shlex
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

import yaml
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from study.config import DEFAULT_TRACKING, BadInputError, Grid, StudySettings, masked

EXIT_FAILED, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 1, 2, 130
EXIT_AGAIN = 75  # of study.train: cells are left, the same command continues
EXITS_AT_ONCE = (EXIT_INTERRUPTED, EXIT_AGAIN)
STOP_SECONDS = 2.0  # that a stopped command has to come to an end by itself
# A disk that is full, a folder that cannot be: the user can change that, anything else is a fault.
WRITE_ERRORS = (
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG),
    *(errno.EACCES, errno.EROFS, errno.ENOTDIR, errno.EEXIST),
)
GRID_OPTIONS = ("heads", "fractions", "encoder_seeds", "policy_seeds", "baseline", "ceiling")


class Parser(argparse.ArgumentParser):
    """An ArgumentParser that names the nearest option when it meets an unknown one."""

    def parse(self, args: Sequence[str]) -> argparse.Namespace:
        """Parse, or exit with code 2 and a message."""
        known, unknown = self.parse_known_args(args)
        if unknown:
            options = [word for word in self.format_help().split() if word.startswith("--")]
            near = difflib.get_close_matches(unknown[0].split("=")[0], options, n=1, cutoff=0.5)
            hint = f"; did you mean {near[0]}?" if near else ""
            self.error(f"unknown setting or word '{unknown[0]}'{hint}")
        return known

    def error(self, message: str) -> NoReturn:
        """Print the message without the long usage, and exit with code 2."""
        self.exit(EXIT_BAD_INPUT, f"error: {masked(message)}\nSee python -m {self.prog} --help\n")


def _value(text: str) -> Any:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise argparse.ArgumentTypeError(f"'{text}' is not valid YAML") from error


def add_options(parser: argparse.ArgumentParser, model: type[BaseModel], names: Sequence[str] = ()) -> None:
    """An option for each field of a settings model, `--group.field` where models nest; those not given stay unset."""
    group = parser.add_argument_group("grid" if model is Grid else "settings")
    for name in names or model.model_fields:
        info = model.model_fields[name]
        kind = info.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            group = parser.add_argument_group(name, (kind.__doc__ or "").split("\n", maxsplit=1)[0])
            for inner, detail in kind.model_fields.items():
                _add(group, f"{name}.{inner}", detail)
        else:
            _add(group, name, info)


def _add(group: Any, name: str, info: FieldInfo) -> None:
    default = info.get_default(call_default_factory=True) if not info.is_required() else None
    usual = "" if default is None else f" [{default}]"
    # A percent sign in argparse's help is a format character.
    text = f"{info.description or name}{usual}".replace("%", "%%")
    group.add_argument(f"--{name}", metavar="V", type=_value, default=argparse.SUPPRESS, help=text)


def add_tracking_option(parser: argparse.ArgumentParser) -> None:
    """Where the results are kept."""
    parser.add_argument(
        "--tracking", default=DEFAULT_TRACKING, metavar="URI", help="MLflow store (default: %(default)s)"
    )


def given(options: argparse.Namespace, names: Sequence[str]) -> dict[str, Any]:
    """The settings that were given on the command line, nested, for the top-level names."""
    nested: dict[str, Any] = {}
    for name, value in vars(options).items():
        group, _, inner = name.partition(".")
        if group not in names:
            continue
        if inner:
            nested.setdefault(group, {})[inner] = value
        else:
            nested[group] = [value] if group in ("heads", "fractions") and not isinstance(value, list) else value
    return nested


def study_overrides(options: argparse.Namespace) -> dict[str, Any]:
    """Overrides of a profile."""
    return given(options, tuple(StudySettings.model_fields))


def grid_overrides(options: argparse.Namespace) -> dict[str, Any]:
    """Overrides of a sweep file."""
    return given(options, GRID_OPTIONS)


def run(main: Callable[[Sequence[str]], int]) -> NoReturn:
    """Run a command's main function; bad input is one line on stderr and exit code 2."""
    try:
        code = main(sys.argv[1:])
    except BadInputError as error:
        print(f"error: {masked(str(error))}", file=sys.stderr)
        code = EXIT_BAD_INPUT
    except BrokenPipeError:  # the reader, such as `head`, has seen enough
        sys.stderr.close()
        code = 0
    if code in EXITS_AT_ONCE:  # Dask would wait for its workers, which end by themselves
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def cannot_write(path: Path, error: OSError) -> str:
    """What to tell a user of one of the WRITE_ERRORS."""
    return (
        f"cannot write {path}: {error.strerror}; make room or name another folder, then give the same command again: "
        "it goes on where it was"
    )


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


def typed(module: str, args: Sequence[str]) -> str:
    """The command line again, for people, without credentials."""
    return masked(shlex.join(["python", "-m", module, *args]))
