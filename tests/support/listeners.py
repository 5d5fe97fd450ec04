"""Records the events that flows send to their listener."""

from __future__ import annotations

from typing import Any

from study.engine.flows import Listener, run_flows


class FlowEvents:
    """Collects the events of some flows, by kind."""

    def __init__(self) -> None:
        self.products: dict[str, Any] = {}
        self.failures: dict[str, Any] = {}
        self.starts: list[Any] = []  # (name, host, process)
        self.steps: list[Any] = []  # (stage, done, total)
        self.logs: list[Any] = []  # (name, stage, epoch, metrics)
        self.retries: list[str] = []  # reasons


def run_and_record(engine, flows):
    """Run flows, given by name, and return their events."""
    events, remaining = FlowEvents(), iter(list(flows.items()))
    listener = Listener(
        finished=events.products.__setitem__,
        failed=events.failures.__setitem__,
        progress=lambda _, *step: events.steps.append(step),
        started=lambda *start: events.starts.append(start),
        log=lambda *log: events.logs.append(log),
        retry=lambda _, reason: events.retries.append(reason),
    )
    run_flows(engine, lambda: next(remaining, None), listener)
    return events
