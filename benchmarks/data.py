"""The data stage by stage, and stock highway-env beside it: `python benchmarks/data.py [--paper-scale FOLDER]`.

Every round drives one town of the paper profile through all stages, one after the other on one core: highway-env's own
searches, ours over the same steps (and the same trajectories, or the benchmark fails), a whole recorded drive, writing
and reading it, painting its frames, storing them. Rates are per second of processor time, so that a busy machine
matters little; what has to wait for a disk is timed by the clock. Printed are medians with the lowest and highest of
the rounds, and the highest resident memory of each stage.

`--paper-scale` makes the paper's data from nothing in FOLDER (about 9 GB, on all cores) and times that by the clock,
with the memory of all its processes. Without it, the last such measurement is kept.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from study.birdview.renderer import Renderer, valid_moments
from study.compute.provenance import ROOT, provenance
from study.config.files import load_profile
from study.config.keys import frames_key
from study.config.paper import IMAGE
from study.config.settings import StudySettings
from study.episode.files import read_episode, write_episode
from study.sim.dynamics import DT
from study.sim.env import Traffic, make_traffic
from study.sim.record import record_episode
from study.stages import size_text

RESULT = Path(__file__).parent / "results" / "data.json"
PROFILE = "paper"
FIRST_SEED = 5_000_000  # towns that no study uses
WARM_UP = 100  # steps before a town is timed
STOCK_STEPS, STEPS = 10, 400
FRAMES = 2000  # painted of each drive
SAMPLE_EVERY = 0.1  # [s], between two looks at the memory of a build
PACKAGES = ("highway-env", "numpy", "opencv-python-headless", "pyarrow")

Timed = dict[str, float]


def timed(stage: str, into: Timed, clock: Callable[[], float], work: Callable[[], Any]) -> Any:
    """Return what `work` returns; its seconds and its highest resident memory go to `into`."""
    Path("/proc/self/clear_refs").write_text("5")  # the highest resident memory is counted anew
    begin = clock()
    result = work()
    into[f"{stage} s"] = clock() - begin
    into[f"{stage} bytes"] = peak_bytes("self")
    return result


def peak_bytes(process: str) -> int:
    """Highest resident memory of a process so far; 0 when it has ended."""
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM")), 0)


# --- one core, stage by stage ---------------------------------------------------------------------------------------


def drive(road: Traffic, steps: int) -> np.ndarray:
    """Drive on by `steps`; the poses after the first STOCK_STEPS of them."""
    poses = np.empty(0)
    for step in range(steps):
        road.act()
        road.step(DT)
        if step == STOCK_STEPS - 1:
            poses = np.array(road.pose())
    return poses


def one_round(settings: StudySettings, seed: int) -> dict[str, float]:
    """Rates of every stage on the town of that seed."""
    t: Timed = {}
    cpu, wall = time.process_time, time.perf_counter
    ours, stock = (make_traffic(settings.town, seed, settings.dynamics) for _ in range(2))
    for road in (ours, stock):
        drive(road, WARM_UP)
    stock.network.fast = False
    theirs = timed("stock", t, cpu, lambda: drive(stock, STOCK_STEPS))
    mine = timed("simulate", t, cpu, lambda: drive(ours, STEPS))
    if not np.array_equal(mine, theirs):
        raise SystemExit(f"town {seed}: the two ways have driven apart")

    episode = timed(
        "record", t, cpu, lambda: record_episode(settings.town, settings.dynamics, settings.recording, seed)
    )
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / episode.id
        timed("write", t, wall, lambda: write_episode(episode, folder))
        written = sum(path.stat().st_size for path in folder.iterdir())
        episode = timed("read", t, wall, lambda: read_episode(folder))
        moments = np.random.default_rng(seed).permutation(valid_moments(episode, settings.birdview))[:FRAMES]
        moments = moments[np.lexsort(moments.T[::-1])]
        images, masks = timed("render", t, cpu, lambda: Renderer(episode, settings.birdview).render(moments))
        timed("pixels", t, cpu, lambda: pixels(settings.birdview.render, len(moments)))
        timed("store", t, wall, lambda: store(Path(scratch) / "frames", (images, masks)))

    vehicles = settings.town.vehicles
    states, recorded = episode.steps * vehicles, (settings.recording.warm_up + settings.recording.duration) / DT
    rates = {
        "stock": STOCK_STEPS * vehicles / t["stock s"],
        "simulate": STEPS * vehicles / t["simulate s"],
        "record": recorded * vehicles / t["record s"],
        "write": states / t["write s"],
        "read": states / t["read s"],
        "render": len(moments) / t["render s"],
        "pixels": len(moments) / t["pixels s"],
        "store": len(moments) / t["store s"],
    }
    return {
        **rates,
        "ratio": rates["simulate"] / rates["stock"],
        "state bytes": written / states,
        "frame bytes": (images.nbytes + masks.nbytes) / len(moments),
        **{name: value for name, value in t.items() if name.endswith("bytes")},
    }


def pixels(side: int, frames: int) -> None:
    """Do what a frame costs before anything is painted: cut the map, colour it, average it; the masks' averages."""
    picture = np.zeros((8 * side, 8 * side), np.uint8)
    table = np.arange(256, dtype=np.uint8)
    canvas, flat = np.empty((side, side), np.uint8), np.empty((side, side), np.uint8)
    turn = cv2.getRotationMatrix2D((side * 4, side * 4), 30, 1)
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP

    def average() -> np.ndarray:
        half = cv2.resize(flat, (side // 2, side // 2), interpolation=cv2.INTER_AREA)
        whole: np.ndarray = cv2.resize(half, (IMAGE, IMAGE), interpolation=cv2.INTER_AREA)
        return whole

    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    for _ in range(frames):
        cv2.warpAffine(picture, turn, canvas.shape, dst=canvas, flags=flags)
        channels = []
        for _ in range(3):
            cv2.LUT(canvas, table, dst=flat)
            channels.append(average())
        cv2.merge(channels)
        for _ in range(2):
            flat.fill(0)
            average()
    cv2.setNumThreads(threads)


def store(path: Path, arrays: tuple[np.ndarray, ...]) -> None:
    """Write arrays with their digests until the disk has them, as the frame store does."""
    with path.open("wb") as stream:
        for array in arrays:
            stream.write(array.data)
            hashlib.sha256(array.data).hexdigest()
        stream.flush()
        os.fsync(stream.fileno())


# --- the paper's data, all cores ------------------------------------------------------------------------------------


def paper_scale(folder: Path) -> dict[str, Any]:
    """Build the profile's data from nothing in `folder`: seconds, frames, memory, the store's digest."""
    settings = load_profile(PROFILE, folder=ROOT / "sweeps")
    if (folder / "data").exists():
        raise SystemExit(f"{folder / 'data'} exists; name a folder without data, the build is to start from nothing")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "sweeps").symlink_to(ROOT / "sweeps")
    command = [sys.executable, "-m", "study.data", "build", "--profile", PROFILE]
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    load = os.getloadavg()[0]
    begin, busy = time.perf_counter(), os.times()
    with subprocess.Popen(command, cwd=folder, env=environment) as build:
        memory = Memory(build.pid)
        recorded = 0.0
        while build.poll() is None:
            memory.look()
            if not recorded and (folder / "data" / "frames").exists():
                recorded = time.perf_counter() - begin
            time.sleep(SAMPLE_EVERY)
    seconds, after = time.perf_counter() - begin, os.times()
    if build.returncode:
        raise SystemExit(f"the build failed with exit code {build.returncode}")
    manifest = json.loads((folder / "data" / "frames" / frames_key(settings) / "manifest.json").read_text())
    return {
        "seconds": round(seconds, 1),
        "frames": sum(entry["frames"] for entry in manifest["sets"].values()),
        "peak_bytes": memory.highest,
        "peak_bytes_together": memory.together,
        "seconds_recording": round(recorded, 1),
        "processor_seconds": round(after[2] + after[3] - busy[2] - busy[3], 1),
        "load_before": load,
        "disk_bytes": sum(path.stat().st_size for path in (folder / "data").rglob("*") if path.is_file()),
        "digest": manifest["digest"],
    }


class Memory:
    """Resident memory of a process and all that it has started: the highest of one, and of all at one time."""

    def __init__(self, root: int) -> None:
        self.root, self.highest, self.together = root, 0, 0

    def look(self) -> None:
        """Look once."""
        parents: dict[int, int] = {}
        for path in Path("/proc").glob("[0-9]*/stat"):
            try:
                parents[int(path.parent.name)] = int(path.read_text().rpartition(")")[2].split()[1])
            except OSError:  # ended meanwhile
                continue
        family = {self.root}
        while more := {child for child, parent in parents.items() if parent in family} - family:
            family |= more
        self.highest = max(self.highest, *(peak_bytes(str(process)) for process in family))
        self.together = max(self.together, sum(resident_bytes(process) for process in family))


def resident_bytes(process: int) -> int:
    """Resident memory of a process now; 0 when it has ended."""
    try:
        return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except OSError:
        return 0


# --- the command ----------------------------------------------------------------------------------------------------


def spread(values: list[float]) -> dict[str, float]:
    """Median, lowest and highest."""
    return {"median": float(np.median(values)), "low": min(values), "high": max(values), "n": len(values)}


def machine() -> dict[str, Any]:
    """Return what it was measured on, and how busy that was before."""
    facts = provenance()
    return {
        "cpu": facts["cpu"],
        "cores": facts["cores"],
        "memory_bytes": os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"),
        "platform": facts["platform"],
        "python": facts["python"],
        "packages": {name: facts["packages"].get(name) for name in PACKAGES},
        "commit": facts["commit"],
        "load_before": os.getloadavg()[0],
    }


def table(rounds: list[dict[str, float]]) -> str:
    """Print the stages for people."""
    units = {
        "stock": "vehicle-frames/s",
        "simulate": "vehicle-frames/s",
        "ratio": "x stock",
        "record": "vehicle-frames/s",
        "write": "vehicle-frames/s",
        "read": "vehicle-frames/s",
        "render": "frames/s",
        "pixels": "frames/s",
        "store": "frames/s",
    }
    lines = [f"{'stage':10}{'median':>10}{'low':>10}{'high':>10}  {'unit':18}memory"]
    for stage, unit in units.items():
        one = spread([values[stage] for values in rounds])
        memory = size_text(max(values.get(f"{stage} bytes", 0) for values in rounds)) if stage != "ratio" else ""
        lines.append(f"{stage:10}{one['median']:10,.0f}{one['low']:10,.0f}{one['high']:10,.0f}  {unit:18}{memory}")
    return "\n".join(lines)


def main() -> None:
    """Measure, print, and keep the result."""
    parser = argparse.ArgumentParser(description="Measure the data stages.")
    parser.add_argument("--rounds", type=int, default=7, help="towns to measure on (default: 7)")
    parser.add_argument("--paper-scale", type=Path, metavar="FOLDER", help="build the paper's data there as well")
    options = parser.parse_args()
    before = json.loads(RESULT.read_text()) if RESULT.exists() else {"paper_scale": None}
    facts = machine()
    whole = before["paper_scale"] if options.paper_scale is None else paper_scale(options.paper_scale)
    settings = load_profile(PROFILE, folder=ROOT / "sweeps")
    one_round(settings, FIRST_SEED - 1)  # imports and caches
    rounds = [one_round(settings, FIRST_SEED + number) for number in range(options.rounds)]
    print(table(rounds))
    all_of = {name: spread([values[name] for values in rounds]) for name in rounds[0]}
    result = {
        "machine": facts,
        "simulate": {
            "per_core": all_of["simulate"]["median"],
            "ratio_to_stock": all_of["ratio"]["median"],
            "spread": {name: all_of[name] for name in ("simulate", "stock", "ratio", "record", "write", "read")},
        },
        "render": {
            "per_core": all_of["render"]["median"],
            "spread": {name: all_of[name] for name in ("render", "pixels", "store")},
        },
        "paper_scale": whole,
    }
    print(json.dumps({name: {k: v for k, v in (part or {}).items() if k != "spread"} for name, part in result.items()}))
    RESULT.parent.mkdir(exist_ok=True)
    RESULT.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
