"""What flows tell their listener, noted."""

from __future__ import annotations

from typing import Any

from study.engine.flows import Listener, run_flows


class Heard:
    """Products, failures and everything else that was told of some flows."""

    def __init__(self) -> None:
        self.products: dict[str, Any] = {}
        self.failures: dict[str, Any] = {}
        self.starts: list[Any] = []  # (name, host, process)
        self.steps: list[Any] = []  # (stage, done, total)
        self.logs: list[Any] = []  # (name, stage, epoch, metrics)
        self.reasons: list[str] = []  # of tasks that were tried again


def listen(engine, flows):
    """Run flows, by name, and return what was heard of them."""
    heard, left = Heard(), iter(list(flows.items()))
    listener = Listener(
        finished=heard.products.__setitem__,
        failed=heard.failures.__setitem__,
        progress=lambda _, *step: heard.steps.append(step),
        started=lambda *start: heard.starts.append(start),
        log=lambda *log: heard.logs.append(log),
        retry=lambda _, reason: heard.reasons.append(reason),
    )
    run_flows(engine, lambda: next(left, None), listener)
    return heard
