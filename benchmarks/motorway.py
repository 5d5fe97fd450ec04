"""Import a whole motorway recording; print its size, the time and the highest memory: `python benchmarks/motorway.py`.

40 minutes at 25 Hz, 2,000 vehicles of which about 30 are there at a time. As steps x agents it would be 120 million
cells, 5 GB. `tests/test_import.py` holds the import to 1 GB.
"""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd

STEPS, AGENTS, ALIVE, RATE_HZ = 60_000, 2_000, 30, 25.0
LANES, WIDTH = 3, 3.5  # of the road [m]


def write_motorway(folder: Path, steps: int = STEPS, agents: int = AGENTS, alive: int = ALIVE) -> None:
    """Write one Episode: vehicles come one after the other, each stays for `alive / agents` of the time."""
    folder.mkdir(parents=True)
    rng = np.random.default_rng(5)
    stay = steps * alive // agents
    start = np.arange(agents) * (steps - stay) // max(agents - 1, 1)
    agent = np.repeat(np.arange(agents), stay)
    time_there = np.tile(np.arange(stay), agents) / RATE_HZ
    pace, phase = 20.0 + 5 * (agent % LANES), rng.uniform(0, 6, agents)[agent]
    x = pace * time_there + 2 * (np.cos(phase) - np.cos(0.5 * time_there + phase))  # speed: pace + sin(...)
    table = pd.DataFrame(
        {
            "step": (np.repeat(start, stay) + np.tile(np.arange(stay), agents)).astype(np.int32),
            "agent": agent.astype(np.int32),
            "x": x.astype(np.float32),
            "y": (WIDTH * (agent % LANES)).astype(np.float32),
            "heading": np.zeros(len(agent), np.float32),
            "speed": (pace + np.sin(0.5 * time_there + phase)).astype(np.float32),
        }
    )
    table.sort_values(["step", "agent"]).to_parquet(folder / "states.parquet", index=False)
    ends = -100.0, float(x.max()) + 100
    lanes = [{"id": lane, "centre": [[end, WIDTH * lane] for end in ends], "width": WIDTH} for lane in range(LANES)]
    (folder / "map.json").write_text(json.dumps({"lanes": lanes, "lights": []}))
    pd.DataFrame({"step": [], "light": [], "state": []}, dtype=np.int32).to_parquet(folder / "lights.parquet")
    pd.DataFrame({"agent": [], "x": [], "y": []}, dtype=np.float32).to_parquet(folder / "routes.parquet")
    files = ("map.json", "states.parquet", "lights.parquet", "routes.parquet")
    head = {
        "schema_version": 1,
        "id": folder.name,
        "source": {"writer": "benchmarks/motorway.py"},
        "rate_hz": RATE_HZ,
        "steps": steps,
        "labels": "none",
        "agents": [{"id": number, "length": 4.5, "width": 1.9} for number in range(agents)],
        "digests": {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in files},
    }
    (folder / "episode.json").write_text(json.dumps(head))


# The process itself says how much it held: to its parent, it would have held no less than the parent did.
IMPORT = """
import sys
from study.data.__main__ import main
if code := main(["import", sys.argv[1], "--out", sys.argv[2]]):
    sys.exit(code)
print(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1])
"""


def import_memory(folder: Path, out: Path) -> tuple[float, int]:
    """Import `folder` in a process of its own; return its seconds and its highest resident memory [bytes]."""
    begin = time.perf_counter()
    command = [sys.executable, "-c", IMPORT, str(folder), str(out)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    return time.perf_counter() - begin, int(done.stdout.split()[-1]) * 1024


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        write_motorway(root / "log" / "motorway")
        size = sum(path.stat().st_size for path in (root / "log").rglob("*") if path.is_file())
        seconds, memory = import_memory(root / "log", root / "out")
        parts = sum(path.is_dir() for path in (root / "out").iterdir())
        print(f"{size / 1e6:.1f} MB on disk, {seconds:.1f} s, {memory / 1e6:.0f} MB at most, {parts} drives")
