"""A sweep as reports read it: its plan and the results of its cells."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from study.config.baselines import BASELINES
from study.config.grid import Cell, Grid
from study.config.settings import StudySettings
from study.results import drives as driving
from study.results.cell_result import CURVE_COLUMNS, TABLE_COLUMNS, CellResult


@dataclass(frozen=True)
class SweepRecord:
    """A sweep as the tracker knows it: what was planned, what is finished, what failed (key -> reason).

    `provenance`: commit, uncommitted diff, versions, machine; `data`: the frame store's manifest; `variants`: sweeps
    that differ in one setting only, by its name; `run_id`: of its run in MLflow; `unread`: what of all this could not
    be read and is left out, and why; `lost`: which of the cells are finished and cannot be read; `drives`: those of
    the cells whose policies have driven in closed loop (`study.results.drives`), by key.
    """

    grid: Grid
    profile: str
    settings: StudySettings
    planned: dict[str, Cell]
    results: dict[str, CellResult]
    failed: dict[str, str] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)
    data: dict[str, Any] = field(default_factory=dict)
    variants: dict[str, SweepRecord] = field(default_factory=dict)
    run_id: str = ""
    unread: tuple[str, ...] = ()
    lost: tuple[str, ...] = ()
    drives: dict[str, pd.DataFrame] = field(default_factory=dict)

    @property
    def complete(self) -> bool:
        """Return whether every planned cell is finished."""
        return set(self.planned) <= set(self.results)

    def table(self, *, baselines: bool = False) -> pd.DataFrame:
        """Return the tidy table: one row per measured point, columns TABLE_COLUMNS, in the order of the plan.

        Stage "drive" has each policy's scores at the wheel: mean over its drives, split is the place.
        A baseline is no head set under study: it is in the table only when asked for.
        """
        tidy = self._tidy
        return tidy if baselines else tidy[~tidy["heads"].isin(BASELINES)].reset_index(drop=True)

    @cached_property
    def _tidy(self) -> pd.DataFrame:
        parts = [
            self._named(cell, part)
            for key, cell in self.planned.items()
            if key in self.results
            for part in (self.results[key].curves, *self._drive_means(key))
        ]
        if not parts:
            return pd.DataFrame(columns=list(TABLE_COLUMNS))
        return pd.concat(parts, ignore_index=True)[list(TABLE_COLUMNS)]

    @cached_property
    def drive_table(self) -> pd.DataFrame:
        """Return the drives of all finished cells: sweep, heads, fraction, encoder_seed and the columns of `drives`."""
        parts = [
            self._named(cell, self.drives[key])
            for key, cell in self.planned.items()
            if key in self.results and key in self.drives
        ]
        names = ["sweep", "heads", "fraction", "encoder_seed"]
        if not parts:
            return pd.DataFrame(columns=[*names, *driving.FACTS])
        table = pd.concat(parts, ignore_index=True)
        return table[[*names, *(name for name in table.columns if name not in names)]]

    def _named(self, cell: Cell, rows: pd.DataFrame) -> pd.DataFrame:
        return rows.assign(
            sweep=self.grid.name, heads=cell.heads, fraction=cell.fraction, encoder_seed=cell.encoder_seed
        )

    def _drive_means(self, key: str) -> list[pd.DataFrame]:
        """Return the scores at the wheel of a cell's policies as rows of the tidy table, columns CURVE_COLUMNS."""
        if key not in self.drives:
            return []
        tables = [driving.means(self.drives[key], place).assign(split=place).reset_index() for place in driving.PLACES]
        tidy = pd.concat(tables).melt(["policy_seed", "split"], var_name="metric")
        tidy = tidy[np.isfinite(tidy["value"])]
        return [tidy.assign(stage="drive", epoch=self.settings.policy.epochs)[list(CURVE_COLUMNS)]]
