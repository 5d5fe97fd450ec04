"""Let Optuna decide which cell runs next, by its public `ask` and `tell`, in the one process that runs the sweep.

A trial is one run of a cell; its only parameter is the cell's label with its key, as one string. MLflow, not Optuna,
knows what is done, so trials that an earlier process left open are closed at the start.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

import optuna
from optuna.exceptions import StorageInternalError
from optuna.trial import Trial, TrialState
from sqlalchemy.exc import SQLAlchemyError  # comes with optuna, which lets some of them through

from study.errors import BadInputError, masked

PARAMETER = "cell"


class Trials:
    """The cells of one plan, as trials of an Optuna study in a SQLite file. One process at a time may use a file."""

    def __init__(self, file: Path, study: str, labels: Mapping[str, str], order: Iterable[str]) -> None:
        """Queue the cells of these keys in this order. Raises BadInputError when the file cannot be used."""
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self._file = file
        self._names = {key: f"{label} {key}" for key, label in labels.items()}
        self._running: dict[str, Trial] = {}
        self._queued = list(order)
        with _guard(self._file):
            file.parent.mkdir(parents=True, exist_ok=True)
            self._study = optuna.create_study(
                study_name=study, storage=f"sqlite:///{file}", direction="maximize", load_if_exists=True
            )
            self._close_open()
            for key in self._queued:
                self._study.enqueue_trial({PARAMETER: self._names[key]})

    def _close_open(self) -> None:
        """Close the trials that are open."""
        for trial in self._study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            self._study.tell(trial.number, state=TrialState.FAIL)
        for _ in self._study.get_trials(deepcopy=False, states=(TrialState.WAITING,)):
            self._study.tell(self._study.ask(), state=TrialState.PRUNED)

    def ask(self) -> str | None:
        """Return the key of the cell to run next, or None when there is none."""
        if not self._queued:
            return None  # Optuna would invent one
        with _guard(self._file):
            trial = self._study.ask()
            name = trial.suggest_categorical(PARAMETER, list(self._names.values()))
        key = next(key for key in self._queued if self._names[key] == name)
        self._queued.remove(key)
        self._running[key] = trial
        return key

    def finish(self, key: str, score: float) -> None:
        """Record that a cell is finished, with a score for Optuna's dashboard."""
        with _guard(self._file):
            self._study.tell(self._running.pop(key), score)

    def fail(self, key: str, reason: str) -> None:
        """Record that a cell has failed."""
        with _guard(self._file):
            trial = self._running.pop(key)
            trial.set_user_attr("reason", masked(reason)[:2000])
            self._study.tell(trial, state=TrialState.FAIL)

    def stop(self) -> None:
        """Close the trials that are open: the sweep was stopped."""
        with _guard(self._file):
            self._close_open()


@contextmanager
def _guard(file: Path) -> Iterator[None]:
    try:
        yield
    except (StorageInternalError, SQLAlchemyError, OSError) as error:
        reason = " ".join(str(error.__cause__ or error).partition("\n[SQL")[0].split())[:300]
        raise BadInputError(
            f"{file}, where Optuna keeps the order of the cells, cannot be used: {reason}; make room, or "
            "move the file away (it holds no results)"
        ) from None


def forget(file: Path, studies: Iterable[str]) -> None:
    """Delete studies from Optuna's file, where they are in it."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    for name in studies if file.is_file() else ():
        with _guard(file), suppress(KeyError):
            optuna.delete_study(study_name=name, storage=f"sqlite:///{file}")
