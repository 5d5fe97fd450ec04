"""Errors that a user can act on, and the exit codes of the commands."""

from __future__ import annotations

import errno
import re
from pathlib import Path


class BadInputError(Exception):
    """Something a user gave cannot be used. Commands print it and exit with code 2, without a traceback.

    The message says what is wrong, what was given, what is allowed and what to do next.
    """


class TrainingDivergedError(RuntimeError):
    """A loss became infinite or no number: the cell has failed, and trying again would not help."""


def one_of(what: str, got: object, allowed: object) -> BadInputError:
    """Return the error for a name that is not among the allowed ones."""
    names = ", ".join(str(name) for name in allowed)  # type: ignore[attr-defined]
    return BadInputError(f"unknown {what} '{got}'; choose from {names}")


def masked(text: str) -> str:
    """Hide the credentials of any URI in a text."""
    text = re.sub(r"(\w://)[^/@\s]*@", r"\1***@", text)
    return re.sub(r"(?i)\b(password=)[^&\s]+", r"\1***", text)


EXIT_FAILED, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 1, 2, 130
EXIT_AGAIN = 75  # of study.sweep train: cells are left, the same command continues
# A disk that is full, a folder that cannot be: the user can change that, anything else is a fault.
WRITE_ERRORS = (
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG),
    *(errno.EACCES, errno.EROFS, errno.ENOTDIR, errno.EEXIST),
)


def cannot_write(path: Path, error: OSError) -> str:
    """Explain one of the WRITE_ERRORS to a user."""
    return (
        f"cannot write {path}: {error.strerror}; make room or name another folder, then give the same command again: "
        "it goes on where it was"
    )
