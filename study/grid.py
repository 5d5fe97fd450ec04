"""Which cell next: an Optuna storage as the queue. It says what to try, never what is done; MLflow says that.

A trial is one try at a cell; its only parameter is the cell's label with its key, as one string. Where a cell stands is
read off its trials and kept nowhere else, so a process may be killed between any two steps:

- WAITING and RUNNING trials are open. Of several open trials of one cell the lowest number counts, and whoever takes
  another drops it (PRUNED): two processes that enqueue the same cell do no harm.
- A FAIL trial says in `outcome` what ended it: "stopped" (on purpose: as if it had not been tried), "passing" (another
  try may help), "hopeless" (none will). Without that word its process is gone, which counts as passing.

On one machine the queue is a SQLite file and one process asks, since SQLite cannot lock a row. Many machines share one
in PostgreSQL. There, a thread records a heartbeat for every trial that is held, by the database's clock; whoever looks
next fails the trials that have had none for the grace period.
"""

from __future__ import annotations

import socket
import threading
import time
import warnings
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from os import getpid
from pathlib import Path
from typing import Any

import optuna
from optuna.exceptions import ExperimentalWarning, StorageInternalError, UpdateFinishedTrialError
from optuna.trial import TrialState
from sqlalchemy.exc import OperationalError, SQLAlchemyError  # comes with optuna, which lets some of them through

from study.config import DEFAULT_GRACE, DEFAULT_QUEUE, SHARED_QUEUES, BadInputError, Cell, masked

PARAMETER = "cell"
TRIES = 3  # at a cell, when what ended the earlier ones can pass
OPEN = (TrialState.WAITING, TrialState.RUNNING)
SQLITE = "sqlite:///"
MAKING = 5  # tries to make the tables: several processes may do so at once
# A lost connection is told within 20 s, not after the system's many minutes; heartbeats are kept in one time zone.
CONNECTION = {
    "connect_timeout": 5,
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 2,
    "tcp_user_timeout": 20_000,
    "application_name": "study",
    "options": "-c timezone=UTC",
}

# That heartbeats are experimental, and are not recorded outside of `optimize`, is known: we record them.
warnings.filterwarnings("ignore", category=ExperimentalWarning)


class QueueLostError(BadInputError):
    """The queue does not answer just now: another try may help."""


@dataclass(frozen=True)
class Ticket:
    """A cell handed out: its key, the trial that stands for it, and which try it is."""

    key: str
    trial: optuna.Trial
    attempt: int

    @property
    def number(self) -> int:
        """Of the trial, in its storage."""
        return int(self.trial._trial_id)  # noqa: SLF001 - storages know trials by it, and there is no other way to it


class Queue:
    """The cells of one plan that wait to be run.

    Every method raises QueueLostError when the storage stops answering, and can be called again after it.
    """

    def __init__(
        self, name: str, planned: dict[str, Cell], storage: str = DEFAULT_QUEUE, grace: float = DEFAULT_GRACE
    ) -> None:
        """Open or create the queue of a plan; `grace` [s] without a heartbeat make a holder count as dead.

        Raises BadInputError when the storage cannot be used.
        """
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self.shared = storage.startswith(SHARED_QUEUES)
        self.failed: dict[str, str] = {}  # cells that are given up, with the reason; as of the last `plan`
        self._labels = {key: f"{cell.label} {key}" for key, cell in planned.items()}
        self._keys = {label: key for key, label in self._labels.items()}
        self._uri, self._grace = masked(storage), grace
        self._judges_from = 0.0
        self._held: set[int] = set()
        self._end = threading.Event()
        if not self.shared and not storage.startswith(SQLITE):
            raise BadInputError(f"queue {self._uri}: give {SHARED_QUEUES[0]}user@host/database, or {DEFAULT_QUEUE}")
        if not self.shared:
            Path(storage.removeprefix(SQLITE)).parent.mkdir(parents=True, exist_ok=True)
        self._storage, self._study = self._open(name, storage)
        if self.shared:
            threading.Thread(target=self._beat_on, daemon=True, name="heartbeats").start()

    def _open(self, name: str, uri: str) -> tuple[Any, optuna.Study]:
        engine = {"pool_pre_ping": True, "connect_args": CONNECTION} if self.shared else None
        beat = {"heartbeat_interval": self._beat, "grace_period": max(1, round(self._grace))} if self.shared else {}
        for tries_left in reversed(range(MAKING if self.shared else 1)):
            try:
                # Optuna fills in braces, which a password may hold.
                storage = optuna.storages.RDBStorage(uri.replace("{", "{{").replace("}", "}}"), engine, **beat)
                study = optuna.create_study(study_name=name, storage=storage, direction="maximize", load_if_exists=True)
            except Exception as error:  # noqa: BLE001 - whatever the database driver raises
                if tries_left and not isinstance(error, OperationalError):
                    time.sleep(0.5)
                    continue
                step = "start the server, or check address and password" if self.shared else "move the file away"
                raise BadInputError(f"cannot open the queue {self._uri}: {_told(error)}; {step}") from None
            return storage, study
        raise AssertionError

    @property
    def _beat(self) -> int:
        return max(1, int(self._grace / 6))  # [s]

    # --- what waits -----------------------------------------------------------------------------------------------

    def plan(self, wanted: Collection[str], *, restart: bool = False, retry_failed: bool = False) -> None:
        """Make exactly the wanted keys wait that are not open, and set `failed` to those that are given up.

        `restart`: what was given up after all its tries is tried again; `retry_failed`: what is hopeless, too.
        """
        with self._guard():
            self._close_lost()
            trials: dict[str, list[optuna.trial.FrozenTrial]] = {key: [] for key in self._labels}
            for trial in self._study.get_trials(deepcopy=False):
                key = self._key(trial)
                if trial.state == TrialState.WAITING and key not in wanted:
                    self._set(trial._trial_id, TrialState.PRUNED)  # noqa: SLF001 - as above
                elif trial.state != TrialState.PRUNED:
                    trials[key].append(trial)
            self.failed = {}
            for key in self._labels:
                if key not in wanted or any(trial.state in OPEN for trial in trials[key]):
                    continue
                attempt = 1
                if trials[key] and trials[key][-1].state == TrialState.FAIL:
                    last = trials[key][-1].user_attrs
                    outcome = last.get("outcome", "lost")
                    attempt = last.get("attempt", 1) + (outcome != "stopped")
                    if restart or retry_failed:
                        attempt = 1
                    if attempt > TRIES or (outcome == "hopeless" and not retry_failed):
                        self.failed[key] = last.get("reason", "the process that ran it is gone")
                        continue
                self._enqueue(key, attempt)

    def _enqueue(self, key: str, attempt: int) -> None:
        self._study.enqueue_trial({PARAMETER: self._labels[key]}, user_attrs={"attempt": attempt})

    def _close_lost(self) -> None:
        """Fail the trials whose process is gone."""
        if self.shared:
            if time.monotonic() >= self._judges_from:
                optuna.storages.fail_stale_trials(self._study)
            return
        for trial in self._study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)):
            if trial._trial_id not in self._held:  # noqa: SLF001 - as above
                self._set(trial._trial_id, TrialState.FAIL)  # noqa: SLF001 - as above

    def open(self) -> set[str]:
        """Keys of the cells that wait or run, here or elsewhere."""
        with self._guard():
            return {self._key(trial) for trial in self._study.get_trials(deepcopy=False, states=OPEN)}

    def running(self) -> bool:
        """Whether anyone runs a cell."""
        with self._guard():
            return bool(self._study.get_trials(deepcopy=False, states=(TrialState.RUNNING,)))

    # --- one cell -------------------------------------------------------------------------------------------------

    def take(self, only: str | None = None) -> Ticket | None:
        """The next waiting cell, or None; `only` asks for one cell."""
        with self._guard():
            # Not `Study.ask`: on an empty queue it makes a trial up, and it leaves a moment without a heartbeat in
            # which a killed process would leave a trial that runs for ever.
            for waiting in self._study.get_trials(deepcopy=False, states=(TrialState.WAITING,)):
                key, number = self._key(waiting), waiting._trial_id  # noqa: SLF001 - as above
                if only not in (None, key):
                    continue
                if self.shared:
                    self._storage.record_heartbeat(number)
                self._held.add(number)
                if not self._set(number, TrialState.RUNNING):  # someone else was faster
                    self._held.discard(number)
                    continue
                others = self._study.get_trials(deepcopy=False, states=OPEN)
                if any(self._key(other) == key and other.number < waiting.number for other in others):
                    self._set(number, TrialState.PRUNED)
                    self._held.discard(number)
                    continue
                trial = optuna.Trial(self._study, number)
                trial.suggest_categorical(PARAMETER, list(self._keys))
                trial.set_user_attr("where", f"{socket.gethostname()} process {getpid()}")
                return Ticket(key, trial, waiting.user_attrs.get("attempt", 1))
        return None

    def hold(self, ticket: Ticket) -> Ticket | None:
        """The ticket while its holder may go on; a new one when it counted as dead and nobody has the cell; or None."""
        with self._guard():
            if self._storage.get_trial(ticket.number).state == TrialState.RUNNING:
                return ticket
            self._held.discard(ticket.number)
            trials = self._study.get_trials(deepcopy=False, states=OPEN)
            states = [trial.state for trial in trials if self._key(trial) == ticket.key]
            if TrialState.RUNNING in states:
                return None
            if not states:
                self._enqueue(ticket.key, ticket.attempt)
        return self.take(ticket.key)

    def done(self, ticket: Ticket, score: float) -> None:
        """The cell is finished; the score is for those who look at the queue in optuna-dashboard."""
        self._tell(ticket, TrialState.COMPLETE, [score])

    def drop(self, ticket: Ticket) -> None:
        """The trial was one too many: the cell is finished, or someone else's."""
        self._tell(ticket, TrialState.PRUNED)

    def stopped(self, ticket: Ticket) -> None:
        """The try was stopped on purpose; the next `plan` makes the cell wait again."""
        self._tell(ticket, TrialState.FAIL, outcome="stopped")

    def fail(self, ticket: Ticket, reason: str, *, passing: bool) -> bool:
        """The try has failed, for a cause that can pass or not. Returns whether the cell will be tried again."""
        self._tell(ticket, TrialState.FAIL, reason=masked(reason), outcome="passing" if passing else "hopeless")
        return passing and ticket.attempt < TRIES

    def _tell(self, ticket: Ticket, state: TrialState, values: list[float] | None = None, **attributes: str) -> None:
        with self._guard():
            with suppress(UpdateFinishedTrialError):  # it counted as dead meanwhile
                for name, value in attributes.items():
                    ticket.trial.set_user_attr(name, value)
            self._set(ticket.number, state, values)
            self._held.discard(ticket.number)

    # --- below ----------------------------------------------------------------------------------------------------

    def _key(self, trial: optuna.trial.FrozenTrial) -> str:
        return self._keys[trial.system_attrs["fixed_params"][PARAMETER]]

    def _set(self, number: int, state: TrialState, values: list[float] | None = None) -> bool:
        """Move a trial to a state; False when another process has moved it before."""
        try:
            return bool(self._storage.set_trial_state_values(number, state, values))
        except UpdateFinishedTrialError:
            return False

    def _beat_on(self) -> None:
        while not self._end.wait(self._beat):
            for number in list(self._held):
                with suppress(QueueLostError), self._guard():
                    self._storage.record_heartbeat(number)

    @contextmanager
    def _guard(self) -> Iterator[None]:
        try:
            yield
        except (StorageInternalError, SQLAlchemyError) as error:
            # When a server was away nobody could record a heartbeat: all get the time to do so again.
            self._judges_from = time.monotonic() + self._grace
            step = "start its server again" if self.shared else "look at disk space and rights"
            raise QueueLostError(f"the queue {self._uri} gave no usable answer: {_told(error)}; {step}") from None

    def close(self) -> None:
        """End the heartbeats: what is still held waits again after the grace period."""
        self._end.set()


def _told(error: BaseException) -> str:
    cause = error.__cause__ if isinstance(error, StorageInternalError) and error.__cause__ else error
    return " ".join(masked(str(cause)).partition("\n[SQL")[0].split())[:400]
