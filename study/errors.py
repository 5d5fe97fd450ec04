"""Errors that a user can act on, and the exit codes of the commands."""

from __future__ import annotations

import errno
import os
import re


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
    """Hide the credentials of any URI in a text, and write what is no character, as names of files may be, as code."""
    text = text.encode(errors="backslashreplace").decode()
    text = re.sub(r"(\w://)[^/@\s]*@", r"\1***@", text)
    return re.sub(r"(?i)\b(password=)[^&\s]+", r"\1***", text)


EXIT_FAILED, EXIT_BAD_INPUT, EXIT_INTERRUPTED = 1, 2, 130
EXIT_AGAIN = 75  # of study.sweep train: cells are left, the same command continues
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
# A disk that is full, a folder that cannot be: the user can change that, anything else is a fault.
WRITE_ERRORS = (
    *(*FULL, errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EEXIST),
    *(errno.EISDIR, errno.ELOOP, errno.ENAMETOOLONG),
)
FULL_WORDS = (  # what libraries say of a full disk in errors of their own, in small letters
    *("no space left on device", "disk quota exceeded", "disk is full"),
    *("pytorchstreamwriter", "inline_container.cc", "iostream error", "file write failed"),  # torch's archives
)
WRITERS = (
    "no usable temporary directory",  # of Python, where TMPDIR and /tmp cannot be written
    *FULL_WORDS,
)
GO_ON = "make room or name another folder, then give the same command again: it goes on where it was"


def write_failure(error: BaseException) -> str | None:
    """Return what to tell a user when an error, or one behind it, says that a file cannot be written; else None."""
    if isinstance(error, OSError) and error.errno in WRITE_ERRORS:
        return f"cannot write {error.filename2 or error.filename or 'a file'}: {error.strerror}; {GO_ON}"
    if swept := _swept(error):
        return f"the folder {swept} is not there, or was removed while it was in use; {GO_ON}"
    if not isinstance(error, BadInputError) and any(words in str(error).lower() for words in WRITERS):
        return f"cannot write a file: {str(error).splitlines()[0]}; {GO_ON}"
    behind = error.__cause__ or (None if error.__suppress_context__ else error.__context__)
    if behind is None or (isinstance(behind, OSError) and behind.errno not in FULL):
        return None
    return write_failure(behind)


def _swept(error: BaseException) -> str | None:
    """Return the folder in which a file was to be written or read, when that is gone; else None."""
    if isinstance(error, FileNotFoundError) and isinstance(error.filename, str | os.PathLike):
        folder = os.path.dirname(os.path.abspath(os.fspath(error.filename)))  # noqa: PTH100, PTH120 - bytes are paths, too
        return None if os.path.isdir(folder) else str(folder)  # noqa: PTH112
    return None


def full_place(error: BaseException) -> str | None:
    """Return what could not be written when an error, or one behind it, tells of a full disk; "": that is unknown."""
    behind: BaseException | None = error
    while behind is not None:
        if isinstance(behind, OSError) and behind.errno in FULL:
            return str(behind.filename2 or behind.filename or "")  # a copy names its source first
        if any(words in str(behind).lower() for words in FULL_WORDS):
            return ""
        behind = behind.__cause__ or (None if behind.__suppress_context__ else behind.__context__)
    return None
