"""A user's own driver: a function of an `Observation` in a file of theirs."""

from __future__ import annotations

import importlib.util
import traceback
from pathlib import Path

from study.driving.actors import FunctionActor
from study.errors import BadInputError


def function_actor(text: str) -> FunctionActor:
    """Return the actor that FILE.py:function names. Raises BadInputError for one that cannot be loaded."""
    file, _, name = text.rpartition(":")
    path = Path(file)
    if path.suffix != ".py" or not name.isidentifier():
        raise BadInputError(f"actor '{text}': give FILE.py:function, such as my_driver.py:drive, or expert")
    if not path.is_file():
        raise BadInputError(f"actor '{text}': there is no file {path}")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None  # of a file that ends in .py
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise BadInputError(f"actor '{text}': {path} raised {type(error).__name__}: {error}{place(error)}") from error
    function = getattr(module, name, None)
    if not callable(function):
        names = [key for key, value in vars(module).items() if callable(value) and key[0] != "_"]
        raise BadInputError(f"actor '{text}': {path} has no function {name}; it has {', '.join(names) or 'none'}")
    return FunctionActor(function, name)


def place(error: BaseException) -> str:
    """Return the line that raised an error, as " (FILE.py, line N)"."""
    frames = traceback.extract_tb(error.__traceback__)
    return f" ({frames[-1].filename}, line {frames[-1].lineno})" if frames else ""
