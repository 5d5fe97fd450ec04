"""Write files and folders atomically."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """Yield an empty draft of `folder` to write into, which takes its place when the block ends without an error.

    Raises FileNotFoundError when somebody removes the draft meanwhile.
    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}.", dir=folder.parent) as name:
        draft = Path(name) / folder.name
        draft.mkdir()
        try:
            yield draft
            if folder.exists():
                folder.rename(Path(name) / "old")
            draft.rename(folder)
        except (OSError, RuntimeError) as error:  # each writer has one of its own for a folder that is gone
            if draft.exists():
                raise
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), str(draft)) from error


def write_atomic(path: Path, content: bytes) -> None:
    """Write a file atomically: after a kill or a power cut it is the old one or the new one."""
    draft = path.with_name(f".{path.name}.{os.getpid()}")

    def write() -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            with draft.open("wb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            draft.replace(path)
        finally:
            draft.unlink(missing_ok=True)

    twice_if_swept(write)


def twice_if_swept(write: Callable[[], T]) -> T:
    """Write something, and once more when somebody removes the draft meanwhile, as cleaners of temporary files do."""
    try:
        return write()
    except FileNotFoundError:
        return write()


@contextmanager
def scratch_folder() -> Iterator[str]:
    """Yield a new folder among the temporary files, which are made again where somebody has swept them away."""
    Path(tempfile.gettempdir()).mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        yield name
