"""Records of heads, head sets and baselines in modules of one's own."""

from __future__ import annotations

import importlib
from collections.abc import Iterable
from typing import Any

from study.config.baselines import BASELINES
from study.config.heads import HEAD_SETS, HEADS, heads_of
from study.errors import BadInputError

REGISTRIES: dict[str, dict[str, Any]] = {"HEADS": HEADS, "HEAD_SETS": HEAD_SETS, "BASELINES": BASELINES}


def load_modules(names: Iterable[str]) -> None:
    """Add the records in the tuples `HEADS`, `HEAD_SETS` and `BASELINES` of these modules to the program's own.

    Raises BadInputError when a module cannot be imported, has none of them, or gives a known name another meaning.
    """
    for name in names:
        try:
            module = importlib.import_module(name)
        except ImportError as error:
            raise BadInputError(
                f"module '{name}' cannot be used: {error}; "
                "Python must find it where the sweep starts and on every worker"
            ) from error
        further = {registry: getattr(module, registry) for registry in REGISTRIES if hasattr(module, registry)}
        if not further:
            raise BadInputError(
                f"module '{name}' cannot be used: it needs one of {', '.join(REGISTRIES)}, tuples of records"
            )
        for registry, records in further.items():
            for record in records:
                if REGISTRIES[registry].setdefault(record.name, record) != record:
                    raise BadInputError(f"module '{name}': there is another '{record.name}'; choose another name")
        heads_of(record.name for record in further.get("HEAD_SETS", ()))
