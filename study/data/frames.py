"""Frame store: recorded moments as images, masks and labels on disk (Sec. IV-A, V).

A store is a folder, written once and then only read:

`manifest.json`             key, settings, source drives with digests, counts, digests, histograms before and after
`encoder/`, `policy/`       the two sets, from different drives, each with
    `images.npy`            [N, 64, 64, 3] uint8 RGB
    `masks.npy`             [N, K, 512] uint8: pred, plan and those of further heads, 4096 bits each
    `labels.parquet`        one row for each frame, columns LABELS

`study.data.build` writes it.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from study.birdview.renderer import MASK_BYTES
from study.config.paper import IMAGE
from study.data.selection import LABELS, SETS, Indices
from study.episode.head import file_digest
from study.errors import BadInputError
from study.randomness import rng

SCHEMA_VERSION = 2  # 2: labels with keyframes, last commands, limits and weights
PARTS = "parts"  # folder of the notes on what is painted

Bytes = NDArray[np.uint8]


class DamagedFramesError(BadInputError):
    """A damaged store: built again from its drives, it has the same bytes."""


@dataclass(frozen=True)
class Frames:
    """One set of N frames: `images` [N, 64, 64, 3] uint8 RGB, `masks` [N, K, 512] uint8, `labels` with N rows.

    The arrays are memory-mapped; rows are ordered by drive, step and vehicle.
    """

    images: Bytes
    masks: Bytes
    labels: pd.DataFrame

    def __len__(self) -> int:
        """Return N."""
        return len(self.images)

    def indices(self, split: Literal["train", "test"]) -> Indices:
        """Return the rows of a split, sorted."""
        train = self.labels["train"].to_numpy()
        return np.flatnonzero(train if split == "train" else ~train).astype(np.int64)

    def subset(self, fraction: float, unit: Literal["frame", "drive"], seed: int) -> Indices:
        """Return the rows of a random part of the training frames, sorted (Sec. V-B).

        Smaller parts lie within larger ones. `unit`: draw frames, or complete drives. Raises BadInputError when nothing
        is left.
        """
        if not 0 < fraction <= 1:
            raise BadInputError(f"data fraction {fraction}: it must be above 0 and at most 1")
        train = self.indices("train")
        generator = rng(seed, "data fraction")
        if unit == "frame":
            part = generator.permutation(train)[: round(fraction * len(train))]
        else:
            drives = self.labels["episode"].to_numpy()[train]
            drawn = generator.permutation(np.unique(drives))
            part = train[np.isin(drives, drawn[: round(fraction * len(drawn))])]
        if not len(part):
            raise BadInputError(
                f"a fraction of {fraction:g} of the training {unit}s is none at all; choose a larger one"
            )
        return np.sort(part)


@dataclass(frozen=True)
class FrameStore:
    """The two sets of a store, with its key and manifest."""

    encoder: Frames
    policy: Frames
    manifest: dict[str, Any]
    key: str


def shapes(masks: int) -> dict[str, tuple[int, ...]]:
    """Return the shape of one frame in each array of a store with that many masks."""
    return {"images": (IMAGE, IMAGE, 3), "masks": (masks, MASK_BYTES)}


def unpack_masks(masks: Bytes) -> Bytes:
    """Return packed masks [.., 512] as [.., 64, 64] uint8 of 0 and 1."""
    return np.unpackbits(masks, axis=-1).reshape(*masks.shape[:-1], IMAGE, IMAGE)


def epoch_order(indices: Indices, seed: int, epoch: int) -> Indices:
    """Return the rows in the random order of one epoch, which depends on nothing but seed and epoch."""
    return rng(seed, f"encoder epoch {epoch}").permutation(indices)


def open_frames(folder: Path, *, check: bool = False) -> FrameStore:
    """Open the store in `folder`; with `check`, compare every byte of the arrays with the manifest's digests.

    Raises BadInputError when the folder holds no store of this format, and its subclass DamagedFramesError when the
    files differ from the manifest.
    """
    path = folder / "manifest.json"
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
        version = manifest["schema_version"]
    except OSError as error:
        raise BadInputError(f"cannot read {path}: {error.strerror}; is {folder} a frame store?") from error
    except (ValueError, KeyError, TypeError) as error:
        raise DamagedFramesError(f"{path} is no manifest of a frame store ({error!r}): truncated or foreign") from error
    if version != SCHEMA_VERSION:
        raise BadInputError(f"{path}: schema_version is {version!r}; this program reads {SCHEMA_VERSION}")
    try:
        sets = {name: _open_set(folder / name, manifest["sets"][name], check=check) for name in SETS}
        return FrameStore(**sets, manifest=manifest, key=str(manifest["key"]))
    except (KeyError, TypeError, AttributeError) as error:
        raise DamagedFramesError(f"{path} lacks what a manifest holds ({error!r}): truncated or foreign") from error


def _open_set(folder: Path, entry: dict[str, Any], *, check: bool) -> Frames:
    remedy = "study.sweep and study.data build make it again"
    arrays = {}
    masks = entry["arrays"]["masks"]["shape"][1]
    for name, shape in shapes(masks).items():
        path = folder / f"{name}.npy"
        try:
            array = np.load(path, mmap_mode="r", allow_pickle=False)
        except (OSError, ValueError, EOFError) as error:
            raise DamagedFramesError(f"{path} is no complete array ({error}); {remedy}") from error
        expected = (entry["frames"], *shape)
        if array.shape != expected or array.dtype != np.uint8:
            raise DamagedFramesError(
                f"{path} is {array.shape} {array.dtype}, the manifest says {expected} uint8; {remedy}"
            )
        arrays[name] = array
    path = folder / "labels.parquet"
    try:
        if file_digest(path) != entry["labels"]:
            raise DamagedFramesError(f"{path} does not match its digest in the manifest; {remedy}")
        labels = pd.read_parquet(path)
    except (OSError, ValueError) as error:
        raise DamagedFramesError(f"{path} holds no labels ({error}); {remedy}") from error
    if len(labels) != entry["frames"] or list(labels.columns) != list(LABELS):
        raise DamagedFramesError(f"{path} has {len(labels)} rows of {', '.join(labels.columns)}; {remedy}")
    for part in entry["parts"] if check else ():
        rows = slice(part["start"], part["start"] + part["rows"])
        for name, array in arrays.items():
            each = int(np.prod(array.shape[1:]))
            content = np.fromfile(  # not mapped: all of a large store would count as this process's memory
                folder / f"{name}.npy", np.uint8, part["rows"] * each, offset=array.offset + part["start"] * each
            )
            if hashlib.sha256(content.data).hexdigest() != part[name]:
                raise DamagedFramesError(
                    f"{folder / name}.npy, rows {rows.start} to {rows.stop - 1}, does not match its digest in the "
                    f"manifest: changed on disk; {remedy}"
                )
    return Frames(**arrays, labels=labels)
