"""Plans as the command line makes them."""

from __future__ import annotations

from collections.abc import Sequence

import click

from study.planning.options import plan_options
from study.planning.plan import Plan


def plan_of(words: Sequence[str]) -> Plan:
    """Return the plan of a sweep's name and options."""
    command = click.command(plan_options()(lambda plan: plan))
    plan: Plan = command.main(list(words), standalone_mode=False)
    return plan
