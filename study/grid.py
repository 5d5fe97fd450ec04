"""Which cell next: an Optuna storage as the queue. It says what to try, never what is done; MLflow says that.

On one machine the queue is a SQLite file and one process asks, since SQLite cannot lock a row. A trial is a cell; its
only parameter is the cell's label with its key, as one string.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import optuna
from optuna.trial import TrialState

from study.config import BadInputError, Cell, masked

DEFAULT_QUEUE = "sqlite:///mlruns/queue.db"
PARAMETER = "cell"


@dataclass(frozen=True)
class Ticket:
    """A cell handed out: its key, and the trial that stands for it."""

    key: str
    trial: optuna.Trial


class Queue:
    """The cells of one plan that wait to be run."""

    def __init__(self, name: str, planned: dict[str, Cell], storage: str = DEFAULT_QUEUE) -> None:
        """Open or create the queue of a plan. Raises BadInputError when the storage cannot be used."""
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self._wanted: set[str] = set()
        self._keys = {f"{cell.label} {key}": key for key, cell in planned.items()}
        path = storage.removeprefix("sqlite:///")
        if path != storage:
            Path(path).parent.mkdir(parents=True, exist_ok=True)
        try:
            self._study = optuna.create_study(
                study_name=name, storage=storage, direction="maximize", load_if_exists=True
            )
        except Exception as error:  # whatever the database driver raises
            raise BadInputError(
                f"cannot open the queue {masked(storage)}: {masked(str(error))}; move the file away or repair it"
            ) from error

    def plan(self, wanted: Sequence[str]) -> None:
        """Make exactly the wanted keys wait. To be called by the one process that asks.

        Trials that a killed process left running are closed, and their cells wait again when they are still wanted.
        """
        self._wanted = set(wanted)
        for trial in self._study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            self._study.tell(trial.number, state=TrialState.FAIL)
        waiting = {
            self._keys[trial.system_attrs["fixed_params"][PARAMETER]]
            for trial in self._study.get_trials(deepcopy=False, states=(TrialState.WAITING,))
        }
        labels = {key: label for label, key in self._keys.items()}
        for key in wanted:
            if key not in waiting:
                self._study.enqueue_trial({PARAMETER: labels[key]})

    def take(self) -> Ticket | None:
        """The next wanted cell, or None. An empty queue is not asked, since Optuna would make a trial up."""
        while self._study.get_trials(deepcopy=False, states=(TrialState.WAITING,)):
            trial = self._study.ask()
            key = self._keys[str(trial.suggest_categorical(PARAMETER, list(self._keys)))]
            if key in self._wanted:
                return Ticket(key, trial)
            self._study.tell(trial, state=TrialState.FAIL)
        return None

    def again(self, ticket: Ticket, reason: str) -> None:
        """The cell could not be finished for a cause that can pass: it waits again."""
        self.failed(ticket, reason)
        self._study.enqueue_trial({PARAMETER: next(label for label, key in self._keys.items() if key == ticket.key)})

    def done(self, ticket: Ticket, score: float) -> None:
        """The cell is finished; the score is for those who look at the queue in optuna-dashboard."""
        self._study.tell(ticket.trial, score)

    def failed(self, ticket: Ticket, reason: str) -> None:
        """The cell could not be finished."""
        ticket.trial.set_user_attr("reason", reason)
        self._study.tell(ticket.trial, state=TrialState.FAIL)
