"""The baselines that stand beside the head sets: cells whose policies are given something else than a trained latent.

To add one, write a function that returns what its policies see, and add its record here. What an accuracy on a trained
latent is worth is read between the best trivial baseline and the ceiling (docs/paper.md, section 5).
"""

from __future__ import annotations

from dataclasses import dataclass

CEILING = "state"
SUPERVISED = "supervised"


@dataclass(frozen=True)
class Baseline:
    """What policies are given in the place of a latent.

    `word` names it in reports, `about` explains it. `inputs` is the "module:function" that returns what policies see,
    see `study.baselines.inputs`. `trivial`: it has learned nothing from driving, so a latent should beat it. `seeds`:
    how many of it there are. Colour (`#RRGGBB`) and line style in every figure. `driving` is the "module:function" that
    gives policies the same at the wheel, see `study.driving.baselines`, empty where they cannot drive; without `sees`,
    no bird view is painted for it.
    """

    name: str
    word: str
    about: str
    inputs: str
    colour: str
    line: str = ":"
    trivial: bool = True
    seeds: int = 1
    driving: str = ""
    sees: bool = True


# In the order of every table: from what knows least to what knows all.
BASELINES: dict[str, Baseline] = {
    baseline.name: baseline
    for baseline in (
        Baseline(
            "untrained",
            "untrained encoder",
            "the encoder with its initial, random weights",
            "study.baselines.images:untrained",
            "#999999",
            seeds=3,
            driving="study.driving.baselines:untrained",
        ),
        Baseline(
            "image-pca",
            "image, PCA",
            "the first 64 principal components of the image",
            "study.baselines.images:image_components",
            "#56B4E9",
            driving="study.driving.baselines:image_components",
        ),
        Baseline(
            "trail-pca",
            "own trail, PCA",
            "the first 64 principal components of the ego's own trail, without map, lights and other vehicles",
            "study.baselines.images:trail_components",
            "#009E73",
            driving="study.driving.baselines:trail_components",
        ),
        Baseline(
            "last-command",
            "last command",
            "the expert's command of 0.1 s ago, and no image",
            "study.baselines.commands:last_command",
            "#CC79A7",
            driving="study.driving.baselines:last_command",
            sees=False,
        ),
        Baseline(
            SUPERVISED,
            "supervised",
            "the latent of a network of the encoder's shape that was trained end to end on the policy set",
            "study.baselines.supervised:supervised_latents",
            "#8C6D1F",
            line="--",
            trivial=False,
            driving="study.driving.baselines:supervised",
        ),
        Baseline(
            CEILING,
            "true state",
            "what the expert decides its acceleration by: the ceiling",
            "study.baselines.commands:true_state",
            "#666666",
            trivial=False,
            driving="study.driving.baselines:true_state",
            sees=False,
        ),
    )
}
