"""List the sweeps of a store and the cached data with their sizes, and delete chosen ones for good.

python -m study.sweep clean
python -m study.sweep clean heads --profile smoke --dry-run
python -m study.sweep clean --older-than 30 --unused
"""

from __future__ import annotations

import sys
import time
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass

import click

from study.config.workspace import HERE, Workspace
from study.console.display import show_table
from study.data.in_use import sole_use
from study.engine.trials import forget
from study.errors import BadInputError, masked
from study.planning.plan import look_up, study_name
from study.stages import duration_text, size_text
from study.sweep.cached_data import Cached, cached_data, remove, used_keys
from study.sweep.locks import hold_store, store_folder
from study.tracking.cleaning import Deletion, StoredSweep, plan_deletion, shrink, stored_sweeps
from study.tracking.experiment import TrackerLostError
from study.tracking.reader import Reader, is_named

DAY = 86400.0  # [s]
UNKNOWN = "its plan cannot be read, or another version of this program has made it"


@dataclass(frozen=True)
class Choice:
    """Which sweeps to delete, and whether cached data that no remaining sweep uses goes, too."""

    names: tuple[str, ...] = ()
    profile: str | None = None
    older_than: float | None = None  # days
    unused: bool = False

    @property
    def empty(self) -> bool:
        """Return whether nothing is to be deleted."""
        return not self.names and self.older_than is None and not self.unused

    def sweeps(self, stored: Sequence[StoredSweep], now: float) -> list[StoredSweep]:
        """Return the chosen sweeps at a time [s since 1970]. Raises BadInputError for a name that no sweep has."""
        for name in self.names:
            if not any(is_named(sweep.run, name) for sweep in stored):
                known = ", ".join(sorted({sweep.name for sweep in stored})) or "none"
                raise BadInputError(f"no sweep '{name}' in this store; there are: {known}")
        if not self.names and self.older_than is None:
            return []
        return [
            sweep
            for sweep in stored
            if (not self.names or any(is_named(sweep.run, name) for name in self.names))
            and self.profile in (None, sweep.profile)
            and now - sweep.used >= (self.older_than or 0.0) * DAY
        ]


@dataclass(frozen=True)
class Store:
    """What there is: sweeps, the cache, and for each sweep's id the keys of the data that it uses, None if unknown."""

    reader: Reader | None
    sweeps: list[StoredSweep]
    cached: list[Cached]
    keys: Mapping[str, frozenset[str] | None]

    @classmethod
    def look(cls, tracking: str, workspace: Workspace) -> Store:
        """Look, and write nothing."""
        reader = look_up(tracking)
        sweeps = stored_sweeps(reader) if reader else []
        keys = {sweep.id: used_keys(reader, sweep) for sweep in sweeps} if reader else {}
        return cls(reader, sweeps, cached_data(workspace.data), keys)

    def users(self, cached: Cached) -> list[StoredSweep]:
        """Return the sweeps that use a part of the cache; those that are deleted in MLflow do not."""
        return [each for each in self.sweeps if each.state != "deleted" and cached.key in (self.keys[each.id] or ())]


@dataclass(frozen=True)
class Cleaning:
    """What is to be deleted: `deletion` in MLflow, if anything, and parts of the cache; `notes` say what is kept."""

    sweeps: list[StoredSweep]
    deletion: Deletion | None
    cached: list[Cached]
    notes: list[str]

    @property
    def bytes(self) -> int:
        """Return the disk space of what goes, without rows of the database."""
        return (self.deletion.bytes if self.deletion else 0) + sum(each.bytes for each in self.cached)


def clean(choice: Choice, tracking: str, *, show_only: bool, yes: bool, wait: bool, workspace: Workspace = HERE) -> int:
    """List everything, or show and delete what is chosen. Returns the exit code."""
    if choice.empty:
        _list(Store.look(tracking, workspace), tracking, workspace)
        return 0
    if show_only:
        _show(_plan(Store.look(tracking, workspace), choice))
        return 0
    if not yes and not sys.stdin.isatty():
        raise BadInputError("this is not a terminal, so nobody can confirm; look with --dry-run, then add --yes")
    alone = sole_use(workspace.data, wait=wait) if workspace.data.is_dir() else nullcontext()
    with hold_store(workspace, tracking, "clean", wait=wait), alone:
        cleaning = _plan(Store.look(tracking, workspace), choice)
        if not _show(cleaning):
            return 0
        if yes or click.confirm("Delete this for good?"):
            _delete(cleaning, tracking, workspace)
    return 0


def _plan(store: Store, choice: Choice) -> Cleaning:
    """Return what a choice comes to; checks that nothing else would go."""
    chosen = choice.sweeps(store.sweeps, time.time())
    ids = {sweep.id for sweep in chosen}
    remaining = [sweep for sweep in store.sweeps if sweep.id not in ids and sweep.state != "deleted"]
    deletion, notes = None, []
    if chosen and store.reader:
        deletion = plan_deletion(store.reader, chosen, remaining)
        deletion.check()
        for title in dict.fromkeys(user.title for _, user in deletion.stay.values()):
            cells = [run.info.run_name for run, user in deletion.stay.values() if user.title == title]
            notes.append(f"kept, since {title} uses them: {', '.join(cells)}")
    unknown = [sweep.title for sweep in remaining if store.keys[sweep.id] is None]
    kept = frozenset[str]().union(*(store.keys[sweep.id] or () for sweep in remaining))
    theirs = frozenset[str]().union(*(store.keys[sweep.id] or () for sweep in chosen))
    cached = [
        each
        for each in store.cached
        if not each.key or (each.key not in kept and (choice.unused or each.key in theirs))
    ]
    if unknown and cached:
        notes.append(f"kept: cached data, since what {', '.join(unknown)} uses is unknown: {UNKNOWN}")
        cached = []
    return Cleaning(chosen, deletion, cached, notes)


def _show(cleaning: Cleaning) -> bool:
    """Print what goes and what is kept; returns whether anything goes."""
    now = time.time()
    for note in cleaning.notes:
        print(note)
    if not cleaning.sweeps and not cleaning.cached:
        print("nothing to delete")
        return False
    print("to delete:")
    _table([_sweep_row(sweep, now) for sweep in cleaning.sweeps])
    _table([row[:3] for row in _cache_rows((each, ()) for each in cleaning.cached)])
    rows_too = ", and what the database holds of them" if cleaning.sweeps else ""
    print(f"frees {size_text(cleaning.bytes)}{rows_too}")
    return True


def _delete(cleaning: Cleaning, tracking: str, workspace: Workspace) -> None:
    """Delete. The sweeps' runs go last: until then the same command can begin again."""
    remove(cleaning.cached)
    planned = [(sweep.name, sweep.profile, sweep.planned) for sweep in cleaning.sweeps if sweep.planned]
    forget(store_folder(workspace, tracking) / "optuna.db", [study_name(*each) for each in planned])
    freed, deletion = cleaning.bytes, cleaning.deletion
    if deletion:
        deletion.run()
        if deletion.final:
            try:
                freed += shrink(deletion.experiment)
            except TrackerLostError as error:
                print(error, file=sys.stderr)
        else:
            freed -= deletion.bytes
            print(
                f"the runs are marked as deleted in {masked(tracking)}; where its database is, remove them for good: "
                "mlflow gc --backend-store-uri DATABASE"
            )
    print(f"deleted; {size_text(freed)} freed")


def _list(store: Store, tracking: str, workspace: Workspace) -> None:
    now = time.time()
    print(f"sweeps in {masked(tracking)}{'' if store.sweeps else ': none'}")
    _table([_sweep_row(sweep, now) for sweep in store.sweeps])
    print(f"cached data in {workspace.data}{'' if store.cached else ': none'}")
    _table(_cache_rows((each, store.users(each)) for each in store.cached))
    if unknown := [sweep.title for sweep in store.sweeps if store.keys[sweep.id] is None and sweep.state != "deleted"]:
        print(f"what {', '.join(unknown)} uses is unknown: {UNKNOWN}")


def _sweep_row(sweep: StoredSweep, now: float) -> tuple[str, ...]:
    """Return title, run, start, time since the last use, state, cells, size."""
    started = time.strftime("%Y-%m-%d %H:%M", time.localtime(sweep.run.info.start_time / 1000))
    age = max(0.0, now - sweep.used)
    cells = "cells unknown" if sweep.planned is None else f"{sweep.finished} of {len(sweep.planned)} cells"
    size = "on the server" if sweep.bytes is None else size_text(sweep.bytes)
    ago = f"{age / DAY:.0f} days" if age >= 2 * DAY else duration_text(age)
    return sweep.title, sweep.id[:8], started, f"{ago} ago", sweep.state, cells, size


def _cache_rows(cached: Iterable[tuple[Cached, Sequence[StoredSweep]]]) -> list[tuple[str, ...]]:
    """Return kind, number, size and users, with one row for all of a kind that have the same users."""
    groups: dict[tuple[str, str], list[int]] = defaultdict(list)
    for each, users in cached:
        groups[each.kind, ", ".join(dict.fromkeys(sweep.title for sweep in users))].append(each.bytes)
    return [
        (kind, str(len(sizes)), size_text(sum(sizes)), names or "used by none")
        for (kind, names), sizes in groups.items()
    ]


def _table(rows: Sequence[Sequence[str]]) -> None:
    if rows:
        show_table([["", *row] for row in rows], [""] * len(rows))
