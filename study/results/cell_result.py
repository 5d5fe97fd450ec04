"""The result of a cell: a plain value that can be saved, moved between machines and loaded without torch."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from study.config.grid import Cell
from study.config.keys import cell_key
from study.config.settings import StudySettings
from study.errors import BadInputError
from study.products import Arrays, read_product, write_product

FORMAT_VERSION = 2  # 2: keyframes and weights beside the predictions
CURVE_COLUMNS = ("policy_seed", "stage", "split", "epoch", "metric", "value")
TABLE_COLUMNS = ("sweep", "heads", "fraction", "encoder_seed", *CURVE_COLUMNS)
NO_SEED = -1  # policy_seed of rows that belong to the encoder
ARRAYS = ("encoder", "policies", "samples", "predictions")
HEAD = "cell.json"


@dataclass(frozen=True)
class CellResult:
    """A trained encoder and the policies on it. S policy seeds, N test frames of the policy set, K sample frames.

    A baseline has neither an encoder nor samples nor curves of an encoder.

    `curves`: one row per measured point, columns CURVE_COLUMNS; stage "encoder" (metrics loss, loss_rec, loss_pred,
    loss_plan, loss_kl; policy_seed is NO_SEED) or "policy" (the metrics of `study.policy.metrics`); split "train" or
    "test"; epoch counts from 1.
    `encoder`, `policies`: weights by name; those of the policies have a leading axis S, beside `z_mean`, `z_std` [64].
    `samples`: test frames of the encoder set: `input` [K, 64, 64, 3] uint8, and for each head `<head>_output` uint8
    ([K, 64, 64, 3] for rec, [K, 64, 64] else, 255 is one) and `<head>_target` for pred and plan.
    `predictions`: `acceleration` [S, N] uint8 class and `steering` [S, N] float32 after the last epoch, with
    `acceleration_label`, `steering_label`, `episode`, `speed` [m/s], `light` (0 none or green, 1 yellow, 2 red),
    `lead_gap` [m] (NaN: free), `keyframe`, `weight` [N] (see `study.data.selection.LABELS`), and `z` [N, 64] float32
    (not normalised).
    `facts`: floor (majority accuracy on test), heads (entropy and constant of each, see `study.encoder.bounds`), frames
    (counts), seconds per stage, peak_bytes, device, precision, threads, versions: whatever a reader needs to judge the
    numbers.
    """

    cell: Cell
    key: str
    settings: dict[str, Any]
    curves: pd.DataFrame
    encoder: Arrays
    policies: Arrays
    samples: Arrays
    predictions: Arrays
    facts: dict[str, Any]

    @property
    def study(self) -> StudySettings:
        """Return the settings of the study that the cell is of."""
        groups = {name: group for name, group in self.settings.items() if name not in {"policy_seeds", "frames_key"}}
        return StudySettings.model_validate(groups)

    def save(self, folder: Path) -> Path:
        """Write the result as `folder`, atomically."""
        head = {
            "format_version": FORMAT_VERSION,
            "cell": self.cell.model_dump(mode="json"),
            "key": self.key,
            "settings": self.settings,
            "facts": self.facts,
        }
        return write_product(folder, HEAD, head, {part: getattr(self, part) for part in ARRAYS}, self.curves)

    @staticmethod
    def load(folder: Path) -> CellResult:
        """Read what `save` wrote. Raises BadInputError when it is damaged."""
        try:
            head, parts, curves = read_product(folder, HEAD, ARRAYS)
        except BadInputError as error:
            raise BadInputError(f"{error}; run the cell again") from error
        version = head.get("format_version")
        if version != FORMAT_VERSION:
            raise BadInputError(f"{folder}: format {version}; this program reads {FORMAT_VERSION}; run the cell again")
        try:
            cell, settings, facts = Cell.model_validate(head["cell"]), head["settings"], head["facts"]
            return CellResult(cell, str(head["key"]), settings, curves, **parts, facts=facts)
        except (ValueError, KeyError) as error:
            raise BadInputError(f"{folder} is no complete cell result: {error}; run the cell again") from error


def load_results(folder: Path) -> Iterator[CellResult]:
    """Yield the checked results below `folder`, each in a folder named by its key.

    Raises BadInputError when there are none, and for one that is damaged or does not fit its own settings.
    """
    if not folder.is_dir():
        raise BadInputError(f"{folder} is no folder; name the one that 'python -m study.sweep train' wrote with --out")
    paths = sorted(path.parent for path in folder.glob("*/cell.json"))
    if not paths:
        raise BadInputError(f"{folder} holds no cell results; name the folder that 'python -m study.sweep train' wrote")
    for path in paths:
        result = CellResult.load(path)
        if result.key != path.name:
            raise BadInputError(f"{path} holds the result of cell {result.key}; give the folder its own name again")
        try:
            _check(result)
        except (ValueError, KeyError, TypeError) as error:
            raise BadInputError(f"{path} is no result of its own settings ({error}); run the cell again") from error
        yield result


def _check(result: CellResult) -> None:
    """Raise ValueError, KeyError or TypeError where a result does not fit its own settings."""
    settings, seeds, frames = result.study, *(result.settings[name] for name in ("policy_seeds", "frames_key"))
    if cell_key(settings, result.cell, seeds, frames) != result.key:
        raise ValueError("its settings have another key")
    if set(result.curves.columns) != set(CURVE_COLUMNS):
        raise ValueError(f"its curves have columns {', '.join(map(str, result.curves.columns))}")
    if not np.isfinite(result.curves["value"].to_numpy(np.float64)).all():
        raise ValueError("its curves hold values that are not finite")
    for stage, policy_seeds, epochs in (
        ("encoder", [NO_SEED] * (result.cell.baseline is None), settings.encoder.epochs),
        ("policy", list(range(seeds)), settings.policy.epochs),
    ):
        rows = result.curves[result.curves["stage"] == stage]
        if sorted(rows["policy_seed"].unique()) != policy_seeds:
            raise ValueError(f"its {stage} curves are not those of {len(policy_seeds)} seeds")
        for names, points in rows.groupby(["split", "metric", "policy_seed"]):
            if sorted(points["epoch"]) != list(range(1, epochs + 1)):
                raise ValueError(f"its {stage} curve {names} has not {epochs} epochs, each once")
    for name in ("acceleration", "steering"):
        labels, predictions = result.predictions[f"{name}_label"], result.predictions[name]
        if predictions.shape != (seeds, *labels.shape):
            raise ValueError(f"its predictions of {name} are {predictions.shape} for {labels.shape} labels")
