"""A claim: rec+plan alone reaches rec's final accuracy as early as full does. See docs/extend/claim.md.

python -m examples.claim heads --profile smoke
"""

from __future__ import annotations

from study.analysis.claims import CLAIMS, Claim, at_top
from study.analysis.rules import REACHES
from study.console.options import run
from study.report.__main__ import main

PLAN_IS_FAST = Claim(
    name="X1",
    section="none, ours",
    text="rec+plan reaches rec's final accuracy in about 20 of 100 epochs, as full does.",
    needs=("rec", "rec+plan", "full"),
    rule=REACHES,
    pairs=at_top(("rec+plan", "rec"), ("full", "rec")),
)

if __name__ == "__main__":
    CLAIMS[PLAN_IS_FAST.name] = PLAN_IS_FAST
    run(main)
