"""Show what a sweep would run, and what that costs, without loading what it needs to run."""

from __future__ import annotations

import json

from study.config.heads import heads_of
from study.config.paper import parameter_counts
from study.planning.plan import Plan, look_up
from study.stages import DRIVE, Cost, duration_text, size_text, total


def dry_run(plan: Plan, tracking: str, *, as_json: bool) -> int:
    """Print the plan, what of it is finished, and what the rest costs."""
    tracker = look_up(tracking)
    done = tracker.finished(list(plan.cells)) if tracker else {}
    costs = {key: cost for key, cost in plan.costs.items() if key not in done}
    data_cost = Cost(0, 0) if plan.frames_ready or not costs else plan.data_cost
    driven = tracker.driven(plan.settings, plan.drivers) if tracker else {}
    to_drive = [key for key in plan.drivers if key not in driven]
    driving = sum(DRIVE.cost(plan.works[key]) for key in to_drive)
    cost, counts, frames = (
        total([data_cost, Cost(driving, 0), *costs.values()]),
        parameter_counts(),
        plan.settings.frames,
    )
    facts = {
        "sweep": plan.grid.name,
        "profile": plan.profile,
        "cells": [
            {"key": key, **cell.model_dump(), "status": "waiting" if key in costs else "finished"}
            for key, cell in plan.cells.items()
        ],
        "to_drive": to_drive,
        "policy_seeds": plan.grid.policy_seeds,
        "parameters": counts,
        "frames": {"encoder": frames.encoder, "policy": frames.policy},
        "seconds": round(cost.seconds, 1),
        "bytes": cost.bytes,
    }
    if as_json:
        print(json.dumps(facts))
        return 0
    print(f"{plan.title}: {plan.grid.title}\n")
    for key, cell in plan.cells.items():
        state = f"waiting, about {duration_text(costs[key].seconds)}" if key in costs else "finished"
        print(f"  {cell.label:<22} {key}  {plan.grid.policy_seeds} policies  {state}")
    heads = ", ".join(f"{head} head {counts[head]:,}" for head in heads_of(plan.grid.heads))
    where = "there already" if plan.frames_ready else f"about {duration_text(data_cost.seconds)} to make"
    print(f"\nparameters  encoder {counts['encoder']:,}, {heads}")
    print(f"frames      {frames.encoder:,} for encoders, {frames.policy:,} for policies; {where}")
    if plan.drivers:
        left = f"{len(to_drive)} of {len(plan.drivers)} cells to drive, about {duration_text(driving)}"
        print(f"driving     {left if to_drive else 'done'}")
    print(f"disk        about {size_text(cost.bytes)}")
    print(f"time        about {duration_text(cost.seconds)} on 2 CPU cores")
    return 0
