"""What is wrong with an Episode: collected finding by finding, so that all can be shown at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from study.errors import BadInputError


@dataclass(frozen=True)
class Finding:
    """One fault, with file, place, value and what to do; `count` more or less equal ones of this `unit` are meant.

    A warning does not keep a drive from being imported.
    """

    text: str
    count: int = 1
    unit: str = "rows"
    warning: bool = False

    def __str__(self) -> str:
        """Return the finding as one line."""
        return self.text + (f" [{self.count:,} {self.unit}]" if self.count > 1 else "")


@dataclass
class Findings:
    """The findings about the Episode in `folder`."""

    folder: Path
    errors: list[Finding] = field(default_factory=list)
    warnings: list[Finding] = field(default_factory=list)
    rows: int = 0  # that are left out
    values: int = 0  # that are left unknown in rows that stay

    def add(self, file: str, text: str, count: int = 1, unit: str = "rows") -> None:
        """Add a fault of one of the files; `text` follows the file's name."""
        self.errors.append(Finding(f"{self.folder / file}{text}", count, unit))

    def refused(self, error: BadInputError | OSError) -> None:
        """Add an error that names its file itself."""
        text = f"cannot read {error.filename}: {error.strerror}" if isinstance(error, OSError) else str(error)
        self.errors.append(Finding(text))

    def warn(self, file: str, text: str) -> None:
        """Add a warning about one of the files; `text` follows the file's name."""
        self.warnings.append(Finding(f"{self.folder / file}{text}", warning=True))

    def add_rows(
        self,
        bad: NDArray[np.bool_],
        numbers: NDArray[np.int64],
        agents: NDArray[np.integer],
        text: str,
        values: Mapping[str, NDArray[Any]] | None = None,
        file: str = "states.parquet",
    ) -> None:
        """Add one finding for each agent that has bad rows: its first one, and how many there are.

        `numbers` are the rows' numbers in the file, `agents` the ids; `text` is formatted with the row's `values` and
        its agent.
        """
        rows = np.flatnonzero(bad)
        rows = rows[np.argsort(numbers[rows], kind="stable")]
        ids, first, counts = np.unique(agents[rows], return_index=True, return_counts=True)
        for at in np.argsort(first).tolist():
            row = rows[first[at]]
            words = text.format(**{name: array[row] for name, array in (values or {}).items()}, agent=ids[at])
            self.add(file, f", row {numbers[row]}{words}", int(counts[at]), f"rows of agent {ids[at]}")

    def refuse(self, advice: str = "") -> None:
        """Raise BadInputError with the first fault, if there is any, and say how many others there are."""
        if not self.errors:
            return
        others = len(self.errors) - 1
        more = f" (and {others} more finding{'s' if others > 1 else ''})" if others else ""
        raise BadInputError(f"{self.errors[0]}{more}{advice}")
