"""The live display of a sweep: cells, stage, epoch, time left. Plain lines when the output is no terminal."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping, Sequence
from typing import Self

from study.stages import CELL_STAGES, STAGES, Stage, Work, duration_text, share_done

try:
    from study.console import terminal
except ImportError:  # plain lines need no rich, and a machine that only trains may lack it
    terminal = None  # type: ignore[assignment]

LINE_EVERY = 15.0  # [s] between two plain lines
DATA_KEY = ""
# Of the data's time, where the stages are not told apart beforehand: what is over when a stage begins, and its own.
DATA_SHARES = {"record": (0.0, 0.8), "select": (0.8, 0.0), "render": (0.8, 0.2), "describe": (1.0, 0.0)}


def show_table(rows: Sequence[Sequence[str]], styles: Sequence[str]) -> None:
    """Print rows of columns, each row in its style (rich's names) on a terminal; plain aligned text in a pipe."""
    if terminal and sys.stdout.isatty():
        terminal.print_table(rows, styles)
        return
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  ".join(text.ljust(width) for text, width in zip(row, widths, strict=True)).rstrip())


class Display:
    """Shows how far a sweep is. `costs`: expected seconds of each waiting cell, in `stages`; `data_cost`: of the data.

    Times left are the expected ones times what the elapsed ones have shown them to be wrong by.
    """

    def __init__(
        self,
        title: str,
        costs: Mapping[str, float],
        labels: Mapping[str, str],
        data_cost: float,
        works: Mapping[str, Work] | None = None,
        stages: Sequence[Stage] = CELL_STAGES,
    ) -> None:
        self._title, self._labels = title, labels
        self._works, self._stages = works or {}, stages
        self._costs = {DATA_KEY: data_cost, **costs}
        self._shares = dict.fromkeys(self._costs, 0.0)  # of the cell's time, done
        self._state: dict[str, str] = {}  # of what runs now
        self._total = len(labels)
        self._finished = len(labels) - len(costs)
        self._failed = 0
        self._began = self._printed = time.monotonic()
        self._resumed: dict[str, float] = {}
        self._data_since: dict[str, tuple[float, int]] = {}  # data stage -> when it began, and what was there then
        self._live = terminal.live_part() if terminal else None

    def __enter__(self) -> Self:
        self.say(f"{self._title}: {self._finished} of {self._total} cells finished" if self._total else self._title)
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def data(self, stage: str, done: int, total: int) -> None:
        """Show how far the data is; what was there when its stage began does not count as speed."""
        before, part = DATA_SHARES[stage]
        share = before + part * done / max(total, 1)
        now = time.monotonic()
        if stage not in self._data_since:
            self._data_since[stage] = (now, done)
            self._resumed[DATA_KEY] = self._resumed.get(DATA_KEY, 0.0) + share - self._shares[DATA_KEY]
        self._shares[DATA_KEY] = share
        began, there = self._data_since[stage]
        rate = (done - there) / (now - began) if now > began else 0.0
        speed = f", {rate:,.0f}/s" if rate >= 100 else f", {rate:.2g}/s" if rate else ""
        self._state[DATA_KEY] = f"{STAGES[stage].activity} {done:,}/{total:,}{speed}"
        if stage in ("render", "describe") and done == total:
            self._state.pop(DATA_KEY)
        self.tick()

    def start(self, key: str) -> None:
        """Show that a cell starts."""
        self._shares[key] = 0.0
        self._state[key] = "starting"
        self.tick(now=True)

    def progress(self, key: str, stage: str, done: int, total: int) -> None:
        """Show how far a cell is in a stage."""
        kind = STAGES[stage]
        self._shares[key] = share_done(self._stages, self._works[key], kind, done / max(total, 1))
        self._resumed.setdefault(key, self._shares[key] if done > 1 else 0.0)
        self._state[key] = f"{kind.activity}, {kind.unit} {done:,}/{total:,}" if total > 1 else kind.activity
        self.tick()

    def retry(self, key: str, reason: str) -> None:
        """Say that a task of a cell will be tried again, and why."""
        self.say(f"{self._labels[key]}: {reason.strip().splitlines()[-1]}; it will be tried again")

    def finish(self, key: str) -> None:
        """Say that a cell is committed."""
        self._finished += 1
        self._end(key, "finished")

    def fail(self, key: str) -> None:
        """Say that a cell is given up."""
        self._failed += 1
        self._end(key, "FAILED")

    def _end(self, key: str, how: str) -> None:
        self._shares[key] = 1.0
        self._state.pop(key, None)
        self.say(f"{self._labels[key]}: {how}; {self._summary()}")

    def say(self, line: str) -> None:
        """Print a line that stays."""
        if self._live and self._live.is_started:
            self._live.console.print(line, markup=False, highlight=False)
        else:
            print(f"{time.strftime('%H:%M:%S')}  {line}", file=sys.stderr, flush=True)
        self._printed = time.monotonic()

    def left(self) -> float | None:
        """Return the seconds left, or None before anything is known."""
        spent = sum(self._costs[key] * (share - self._resumed.get(key, 0)) for key, share in self._shares.items())
        open_ = sum(self._costs[key] * (1 - share) for key, share in self._shares.items())
        elapsed = time.monotonic() - self._began
        if spent < 1 or elapsed < 1:
            return None
        return open_ * elapsed / spent

    def _summary(self) -> str:
        left = self.left()
        parts = [f"cells {self._finished}/{self._total}"] if self._total else []
        parts += [f"{self._failed} failed"] if self._failed else []
        parts += [] if left is None else [f"about {duration_text(left)} left"]
        return ", ".join(parts)

    def tick(self, *, now: bool = False) -> None:
        """Draw again; a plain line only now and then."""
        if self._live and self._live.is_started:
            rows = ((self._labels.get(key, "data"), self._shares[key], state) for key, state in self._state.items())
            share = self._done() / (sum(self._costs.values()) or 1)
            drawing = terminal.bars(rows, title=self._title, share=share, summary=self._summary())
            self._live.update(drawing, refresh=True)
        elif now or time.monotonic() - self._printed > LINE_EVERY:
            running = "; ".join(f"{self._labels.get(key, 'data')}: {state}" for key, state in self._state.items())
            self.say("; ".join(part for part in (running or "waiting", self._summary()) if part))

    def _done(self) -> float:
        return sum(self._costs[key] * share for key, share in self._shares.items())
