"""Build a frame store from Episodes, in parts that can be resumed."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd
from filelock import FileLock
from numpy.typing import NDArray

from study.atomic import write_atomic
from study.birdview.renderer import Renderer
from study.config.heads import further_masks, mask_heads
from study.config.keys import FORMAT_VERSIONS, content_key
from study.config.settings import BirdviewSettings, FramesSettings
from study.data.frames import PARTS, SCHEMA_VERSION, DamagedFramesError, open_frames, shapes
from study.data.selection import LABELS, SETS, Columns, candidates, choose, histograms
from study.episode.files import read_episode
from study.episode.head import episode_digest, file_digest
from study.errors import BadInputError
from study.stages import RENDER, SELECT, Batch, Flow, Task

CHUNK = 512  # frames painted before they are written: 7 MB


def frames_flow(
    frames: FramesSettings,
    birdview: BirdviewSettings,
    encoder_episodes: Sequence[Path],
    policy_episodes: Sequence[Path],
    folder: Path,
    *,
    key: str | None = None,
    recordings: Mapping[str, str] = MappingProxyType({}),
) -> Flow[None]:
    """Build the frame store `folder` from recorded drives, unless it exists and is undamaged.

    Every drive is read once for its candidate moments, the frames are chosen from all of them (`choose`), then the
    frames of every drive are painted into their rows of preallocated files. Each painted part leaves a note, so that a
    killed build resumes and ends with the same bytes. `recordings`: drive -> what it was cut from; drives of one
    recording train or test, never both. `key` names the store; by default it follows from the settings
    and the drives' digests. Raises BadInputError when the drives give too few frames, serve both sets or are no
    Episodes, or when `folder` holds something else.
    """
    sources = {"encoder": _sources(encoder_episodes), "policy": _sources(policy_episodes)}
    _check_sources(sources)
    build = _Build(
        frames, birdview, {"encoder": encoder_episodes, "policy": policy_episodes}, sources, folder, key, recordings
    )
    folder.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(folder.parent / ".lock"):
        if not build.finished():
            yield from build.flow()


def _sources(paths: Sequence[Path]) -> list[dict[str, str]]:
    return [{"name": path.name, "digest": episode_digest(path)} for path in paths]


def _check_sources(sources: dict[str, list[dict[str, str]]]) -> None:
    seen: dict[str, str] = {}
    for name, items in sources.items():
        if len(items) < 2:
            raise BadInputError(f"the {name} set has {len(items)} drives; it needs one to train and one to test")
        for item in items:
            other = seen.setdefault(item["digest"], name)
            if other != name or items.count(item) > 1:
                raise BadInputError(
                    f"drive {item['name']} serves the {other} set and again the {name} set; every drive serves once, "
                    "and the policy set needs drives of its own (Sec. V-A)"
                )


@dataclass(frozen=True)
class _Build:
    """The inputs and the folder of a build."""

    frames: FramesSettings
    birdview: BirdviewSettings
    paths: dict[str, Sequence[Path]]
    sources: dict[str, list[dict[str, str]]]
    folder: Path
    given_key: str | None
    recordings: Mapping[str, str]

    @property
    def settings(self) -> dict[str, Any]:
        """Return the settings that decide the bytes of the store."""
        return {
            "frames": self.frames.model_dump(mode="json", exclude={"unit"}),
            "birdview": self.birdview.model_dump(mode="json"),
        }

    @property
    def inputs(self) -> str:
        """Return the digest of everything that decides the bytes of the store."""
        inputs = {**self.settings, "sources": self.sources, **({"masks": further_masks()} if further_masks() else {})}
        if cut := {
            path.name: name
            for paths in self.paths.values()
            for path in paths
            if (name := self.recordings.get(path.name))
        }:
            inputs["recordings"] = cut
        return content_key("frames", inputs, (), FORMAT_VERSIONS["frames"])

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Return the shape of one frame in each array."""
        return shapes(len(mask_heads()))

    @property
    def draft(self) -> Path:
        return self.folder.with_name(f".{self.folder.name}.building")

    def finished(self) -> bool:
        """Return whether the folder holds the store of these inputs; a damaged one becomes a draft, to be removed.

        Raises BadInputError when it holds something else.
        """
        if not self.folder.exists():
            return False
        try:
            inputs = open_frames(self.folder, check=True).manifest["inputs"]
        except DamagedFramesError:
            shutil.rmtree(self.draft, ignore_errors=True)
            self.folder.rename(self.draft)
            return False
        if inputs != self.inputs:
            raise BadInputError(
                f"{self.folder} holds frames of other settings or drives; delete it or name another folder"
            )
        return True

    def flow(self) -> Flow[None]:
        plan = yield from self._plan()
        self._allocate(plan)
        parts = yield from self._render()
        manifest = {
            "schema_version": SCHEMA_VERSION,
            "key": self.given_key or self.inputs,
            "inputs": self.inputs,
            "digest": content_key("store", [[plan[name]["columns"], parts[name]] for name in SETS], (), SCHEMA_VERSION),
            "settings": self.settings,
            "sources": self.sources,
            "sets": {
                name: plan[name]
                | {
                    "arrays": {
                        key: {"shape": [plan[name]["frames"], *shape], "dtype": "uint8"}
                        for key, shape in self.shapes.items()
                    },
                    "parts": parts[name],
                }
                for name in SETS
            },
        }
        _write_json(self.draft / "manifest.json", manifest)
        (self.draft / "plan.json").unlink()
        shutil.rmtree(self.draft / PARTS)
        self.draft.rename(self.folder)

    def _plan(self) -> Flow[dict[str, Any]]:
        """Choose the frames and write their labels into the draft, or resume with the choice of a killed build."""
        path = self.draft / "plan.json"
        if path.is_file():
            plan: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            labels = {name: self.draft / name / "labels.parquet" for name in SETS}
            if plan["inputs"] == self.inputs and all(
                file_digest(labels[name]) == plan[name]["labels"] for name in SETS
            ):
                return plan
        if self.draft.exists():
            shutil.rmtree(self.draft)
        tables: list[Columns] = yield Batch(
            [
                Task(SELECT, candidates, (path, number, name, self.frames, self.birdview))
                for name in SETS
                for number, path in enumerate(self.paths[name])
            ]
        )
        plan = {"inputs": self.inputs}
        first = 0
        for name, wanted in (("encoder", self.frames.encoder), ("policy", self.frames.policy)):
            last = first + len(self.paths[name])
            columns = {key: np.concatenate([table[key] for table in tables[first:last]]) for key in LABELS}
            first = last
            groups = [self.recordings.get(path.name, path.name) for path in self.paths[name]]
            rows, decided, test_drives = choose(columns, name, wanted, groups, self.frames)
            before = histograms(columns, np.ones(len(columns["step"]), bool))
            chosen = {key: values[rows] for key, values in columns.items()} | decided
            train = decided["train"]
            (self.draft / name).mkdir(parents=True)
            pd.DataFrame(chosen).to_parquet(self.draft / name / "labels.parquet", index=False)
            plan[name] = {
                "frames": len(rows),
                "train": int(train.sum()),
                "test": int((~train).sum()),
                "test_drives": test_drives,
                "labels": file_digest(self.draft / name / "labels.parquet"),
                "columns": hashlib.sha256(b"".join(chosen[key].tobytes() for key in LABELS)).hexdigest(),
                "candidates": before,
                "chosen": {"all": histograms(chosen, np.ones(len(rows), bool))}
                | {split: histograms(chosen, train == (split == "train")) for split in ("train", "test")},
            }
        _write_json(path, plan)
        return plan

    def _allocate(self, plan: dict[str, Any]) -> None:
        """Allocate all arrays at once, so that a full disk shows now and not in an hour."""
        if (self.draft / PARTS).is_dir():
            return
        for name in SETS:
            for key, shape in self.shapes.items():
                path = self.draft / name / f"{key}.npy"
                np.lib.format.open_memmap(path, mode="w+", dtype=np.uint8, shape=(plan[name]["frames"], *shape))
                with path.open("r+b") as stream:
                    os.posix_fallocate(stream.fileno(), 0, path.stat().st_size)
        (self.draft / PARTS).mkdir()

    def _render(self) -> Flow[dict[str, list[dict[str, Any]]]]:
        targets = [head.target for head in mask_heads().values()]
        tasks: list[Task] = []
        notes: list[Path] = []
        done = 0
        for name in SETS:
            labels = pd.read_parquet(self.draft / name / "labels.parquet")
            episode, step, agent = (labels[key].to_numpy() for key in ("episode", "step", "agent"))
            starts = np.flatnonzero(np.diff(episode, prepend=-1))
            for start, end in zip(starts.tolist(), [*starts[1:].tolist(), len(episode)], strict=True):
                notes.append(self.draft / PARTS / f"{name}-{start:09d}.json")
                if notes[-1].is_file():
                    done += end - start
                    continue
                moments = np.stack([step[start:end], agent[start:end]], axis=1)
                part = (self.paths[name][episode[start]], self.birdview, moments, self.draft / name, start)
                tasks.append(Task(RENDER, _render_part, (*part, notes[-1], targets), end - start))
        yield Batch(tasks, done)
        parts: dict[str, list[dict[str, Any]]] = {name: [] for name in SETS}
        for note in notes:  # in the order of their rows
            parts[note.name.partition("-")[0]].append(json.loads(note.read_text(encoding="utf-8")))
        return parts


def _write_json(path: Path, content: dict[str, Any]) -> None:
    write_atomic(path, json.dumps(content, indent=1, allow_nan=False).encode())


def _render_part(
    path: Path,
    settings: BirdviewSettings,
    moments: NDArray[np.int32],
    folder: Path,
    start: int,
    note: Path,
    targets: Sequence[str],
) -> None:
    """Paint frames of one drive, [M, 2] of (step, agent id), into the rows from `start` on, and write a note of it."""
    episode = read_episode(path)
    positions = {agent.id: index for index, agent in enumerate(episode.agents)}
    where = np.array([(step, positions[agent]) for step, agent in moments.tolist()])
    renderer = Renderer(episode, settings, targets)
    names = tuple(shapes(len(targets)))
    digests = {name: hashlib.sha256() for name in names}
    with contextlib.ExitStack() as stack:
        streams = {}
        for name in names:
            array = np.load(folder / f"{name}.npy", mmap_mode="r")
            streams[name] = stack.enter_context((folder / f"{name}.npy").open("r+b"))
            streams[name].seek(array.offset + start * array[:1].nbytes)
        for first in range(0, len(where), CHUNK):
            for name, frames in zip(names, renderer.render(where[first : first + CHUNK]), strict=True):
                streams[name].write(frames.data)
                digests[name].update(frames.data)
        for stream in streams.values():
            stream.flush()
            os.fsync(stream.fileno())  # a power cut must not take back rows that the note tells of
    _write_json(note, {"start": start, "rows": len(where), **{name: digests[name].hexdigest() for name in names}})
