"""Choose what the paper leaves open about town and vehicles, by baselines alone (docs/paper.md, section 5).

No encoder with heads is trained here, so no choice can favour a head set. For each plausible setting, drives are
recorded and every baseline's policies are trained; a table says what a latent could show there.

The rule, written down before any of these settings was tried on this table:

1. A setting is eligible when no vehicle collides, at most 2 % of vehicle time is spent standing for longer than a cycle
   of the lights, and at most 3 % of the moving labels are unlike both of their neighbours (labels that flip back and
   forth cannot be learned from one image).
2. Of the eligible settings, the one with the largest room is chosen: accuracy on the true state, less that of the best
   trivial baseline (untrained encoder, PCA of the image, PCA of the ego's trail, last command).
3. Where the room of two differs by less than one point, the one with fewer departures from the plain town is taken.

    python benchmarks/town_settings.py [NAME ...]     try these settings, or all; what was tried is kept
    python benchmarks/town_settings.py --table        print the table of what was tried
"""

from __future__ import annotations

import json
import pkgutil
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from study.baselines.inputs import BaselineInputs
from study.config.baselines import BASELINES, CEILING
from study.config.files import load_profile, merge
from study.config.paper import STEERING_CROP
from study.config.settings import StudySettings
from study.data.frames import FrameStore, open_frames
from study.data.prepare import data_flow, drives_folder
from study.engine.flows import run_flow
from study.episode.files import read_episode
from study.policy.training import train_policies

RESULTS = Path(__file__).with_name("results") / "town_settings"
POLICY_SEEDS = 2
SIZE = {
    "recording": {"encoder_episodes": 6, "policy_episodes": 32},
    "frames": {"encoder": 2000, "policy": 4000},
}
OLD = {"dynamics": {"steering_unit": 2.4}, "town": {"per_drive": True, "brake_hold": 0.5, "road_limits": []}}
LIMITS = [20.0, 30.0, 40.0]  # above 40 km/h, braking for a light begins before the light is in the picture


def _setting(lag: float, hold: float, *, wheel: float = 0.0, limits: bool = False, per_drive: bool = False) -> Any:
    town: dict[str, Any] = {"brake_hold": hold, "per_drive": per_drive, "road_limits": LIMITS if limits else []}
    return {"dynamics": {"lag": lag, "wheel_lag": wheel}, "town": town}


SETTINGS: dict[str, dict[str, Any]] = {
    "old": OLD,
    "plain": _setting(0, 0),
    "hold": _setting(0, 0.5),
    "lag-0.2": _setting(0.2, 0),
    "lag-0.4": _setting(0.4, 0),
    "lag-0.6": _setting(0.6, 0),
    "lag-0.4-wheel": _setting(0.4, 0, wheel=0.1),
    "lag-0.4-hold": _setting(0.4, 0.5),
    "limits": _setting(0, 0, limits=True),
    "limits-hold": _setting(0, 0.5, limits=True),
    "limits-lag-0.4": _setting(0.4, 0, limits=True),
    "limits-lag-0.4-wheel": _setting(0.4, 0, wheel=0.1, limits=True),
    "limits-lag-0.4-hold-0.2": _setting(0.4, 0.2, limits=True),
    "limits-lag-0.4-hold-0.3": _setting(0.4, 0.3, limits=True),
    "limits-lag-0.4-hold": _setting(0.4, 0.5, limits=True),
    "limits-lag-0.2-hold-0.2": _setting(0.2, 0.2, limits=True),
    "limits-lag-0.1-hold-0.2": _setting(0.1, 0.2, limits=True),
    "limits-hold-0.2": _setting(0, 0.2, limits=True),
    "lag-0.2-hold-0.2": _setting(0.2, 0.2),
    "limits-lag-0.4-towns": _setting(0.4, 0, limits=True, per_drive=True),
}


def main() -> None:
    """Try settings, or print the table."""
    torch.set_num_threads(1)
    names = [name for name in sys.argv[1:] if not name.startswith("-")]
    for name in [] if "--table" in sys.argv else names or SETTINGS:
        file = RESULTS / f"{name}.json"
        if file.is_file():
            continue
        started = time.time()
        row = _try(load_profile("laptop", merge(SIZE, SETTINGS[name])))
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps({"setting": SETTINGS[name], **row}, indent=1) + "\n", encoding="utf-8")
        print(f"{name}: {time.time() - started:.0f} s", file=sys.stderr)
    print(_table())


def _try(settings: StudySettings) -> dict[str, Any]:
    """Return what is to be known of a setting."""
    root = Path(tempfile.mkdtemp(prefix="town-settings-"))
    try:
        store = open_frames(run_flow(data_flow(settings, root)))
        drives = drives_folder(settings, root)
        return {"traffic": _traffic(drives), **_scores(store, drives, settings)}
    finally:
        shutil.rmtree(root)


def _traffic(folder: Path) -> dict[str, float]:
    """Return collisions, standing, consistency of the labels and the share of steering beyond the paper's crop."""
    rows = []
    for path in sorted(folder.glob("[0-9]*")):
        episode = read_episode(path)
        known = episode.present & np.isfinite(episode.acceleration)
        inner = known[:-2] & known[1:-1] & known[2:] & (episode.speed[1:-1] > 0.1)
        before, now, after = episode.acceleration[:-2], episode.acceleration[1:-1], episode.acceleration[2:]
        alone = inner & (now != before) & (now != after)
        facts = episode.source["traffic"]
        rows.append(
            (
                facts["collided_vehicles"],
                facts["standing_longer_than_cycle"],
                alone.sum() / inner.sum(),
                (np.abs(episode.steering[known]) > STEERING_CROP).mean(),
                facts["mean_speed"],
            )
        )
    collided, standing, alone, beyond, speed = np.array(rows, float).T
    return {
        "collided": int(collided.sum()),
        "standing": standing.mean(),
        "inconsistent": alone.mean(),
        "beyond_crop": beyond.mean(),
        "mean_speed": speed.mean(),
    }


def _scores(store: FrameStore, drives: Path, settings: StudySettings) -> dict[str, Any]:
    """Return final accuracies of every baseline's policies on the test drives, and what they are measured against."""
    labels, rows = store.policy.labels, {split: store.policy.indices(split) for split in ("train", "test")}
    test = labels.iloc[rows["test"]]
    scores = {}
    for name, baseline in BASELINES.items():
        inputs = BaselineInputs(store, drives, settings, 0, "cpu", lambda *_: None)
        z = pkgutil.resolve_name(baseline.inputs)(inputs)
        trained = train_policies(
            *(z[rows[split]] for split in ("train", "test")),
            *(labels.iloc[rows[split]].reset_index(drop=True) for split in ("train", "test")),
            range(POLICY_SEEDS),
            settings.policy,
        )
        late = trained.curves[
            (trained.curves["split"] == "test") & (trained.curves["epoch"] > settings.policy.epochs - 5)
        ]
        scores[name] = late.groupby("metric")["value"].mean().to_dict()
    return {
        "floor": float(np.bincount(test["acceleration"]).max() / len(test)),
        "keyframes": float(test["keyframe"].mean()),
        "scores": scores,
    }


def _table() -> str:
    """Return the table as Markdown: accuracies in percent, in brackets on keyframes."""
    trivial = [name for name, baseline in BASELINES.items() if baseline.trivial]
    header = [
        "setting",
        "floor",
        *BASELINES,
        "room",
        "keyframes",
        "inconsistent",
        "beyond ±0.25",
        "collided",
        "standing",
    ]
    lines = [header, ["---"] * len(header)]
    for name in SETTINGS:
        file = RESULTS / f"{name}.json"
        if not file.is_file():
            continue
        row = json.loads(file.read_text(encoding="utf-8"))
        accuracy = {key: 100 * score["acceleration_accuracy"] for key, score in row["scores"].items()}
        keyframe = {key: 100 * score["keyframe_accuracy"] for key, score in row["scores"].items()}
        room = accuracy[CEILING] - max(accuracy[key] for key in trivial)
        on_keyframes = keyframe[CEILING] - max(keyframe[key] for key in trivial)
        traffic = row["traffic"]
        lines.append(
            [
                name,
                f"{100 * row['floor']:.1f}",
                *(f"{accuracy[key]:.1f} ({keyframe[key]:.1f})" for key in BASELINES),
                f"{room:.1f} ({on_keyframes:.1f})",
                f"{100 * row['keyframes']:.0f} %",
                f"{100 * traffic['inconsistent']:.1f} %",
                f"{100 * traffic['beyond_crop']:.1f} %",
                str(traffic["collided"]),
                f"{100 * traffic['standing']:.1f} %",
            ]
        )
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


if __name__ == "__main__":
    main()
