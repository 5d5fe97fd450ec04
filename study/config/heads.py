"""The decoder heads and the paper's sets of them."""

from __future__ import annotations

HEADS: dict[str, int] = {"rec": 3, "pred": 1, "plan": 1}  # decoder head -> output channels
HEAD_SETS: dict[str, tuple[str, ...]] = {
    "rec": ("rec",),
    "rec+pred": ("rec", "pred"),
    "rec+plan": ("rec", "plan"),
    "full": ("rec", "pred", "plan"),
}
CEILING = "state"  # in the place of a head set: a cell without encoder, whose policies are given the true state
