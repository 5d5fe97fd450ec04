"""The decoder heads and the sets of them that a study compares; what a head or a head set is called is written here."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from study.errors import one_of

IMAGE_TARGET = "image"


@dataclass(frozen=True)
class Head:
    """A decoder head.

    `word` names it in reports. `channels` of the output: 3 for the image, 1 for a mask. `target` is what the head
    learns: "image" is the input itself; else the mask that a function of `study.birdview.targets` paints, or, as
    "module:function", one of another module. `loss` is a key of `study.encoder.autoencoder.LOSSES`.
    """

    name: str
    channels: int
    word: str
    target: str
    loss: str = "cross-entropy"


@dataclass(frozen=True)
class HeadSet:
    """Heads that are trained together on one encoder; colour (of `#RRGGBB`), line style and marker in every figure."""

    name: str
    heads: tuple[str, ...]
    word: str
    colour: str
    line: str
    marker: str


# The order of the heads is that of the masks in a frame store; the order of the head sets is that of every table.
HEADS: dict[str, Head] = {
    head.name: head
    for head in (
        Head("rec", 3, "reconstruction", IMAGE_TARGET),
        Head("pred", 1, "prediction", "pred"),
        Head("plan", 1, "planning", "plan"),
    )
}
HEAD_SETS: dict[str, HeadSet] = {
    head_set.name: head_set
    for head_set in (
        HeadSet("rec", ("rec",), "reconstruction", "#000000", "-", "o"),
        HeadSet("rec+pred", ("rec", "pred"), "reconstruction and prediction", "#E69F00", "-.", "^"),
        HeadSet("rec+plan", ("rec", "plan"), "reconstruction and planning", "#0072B2", "--", "s"),
        HeadSet("full", ("rec", "pred", "plan"), "all three heads", "#D55E00", "-", "D"),
    )
}
PAPER_MASKS = ("pred", "plan")  # targets in every frame store


def mask_heads() -> dict[str, Head]:
    """Return the heads that learn a mask, in the order of the masks in a frame store."""
    return {name: head for name, head in HEADS.items() if head.target != IMAGE_TARGET}


def further_masks() -> list[str]:
    """Return the targets of masks that the paper does not have: with any, a frame store has another key."""
    return [head.target for head in mask_heads().values() if head.target not in PAPER_MASKS]


def heads_of(head_sets: Iterable[str]) -> list[str]:
    """Return the heads of known head sets, in the order of HEADS. Raises BadInputError for an unknown head."""
    wanted = [head for name in head_sets if name in HEAD_SETS for head in HEAD_SETS[name].heads]
    for head in wanted:
        if head not in HEADS:
            raise one_of("head", head, HEADS)
    return [head for head in HEADS if head in wanted]
