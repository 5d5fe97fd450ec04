"""Examine an Episode of another writer: all that is wrong with it, and what is left without it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from study.episode.findings import Findings
from study.episode.recording import Recording, read_recording
from study.episode.rows import select
from study.intake.adapt import SLOWEST_RATE
from study.intake.motion import motion_faults
from study.intake.places import check_places

ROUNDS = 5  # what is left of an agent can be wrong again


def examine(folder: Path, findings: Findings) -> Recording | None:
    """Return what is right in an Episode, None where nothing is; `findings` get all that is wrong."""
    recording = read_recording(folder, findings)
    if recording is None:
        return None
    if recording.rate_hz < SLOWEST_RATE:
        findings.add(
            "episode.json",
            f", field 'rate_hz': {recording.rate_hz:g} steps per second are too few to tell how vehicles moved; "
            f"{SLOWEST_RATE:g} or more are needed",
        )
        return None
    later = findings
    for _ in range(ROUNDS):
        bad = motion_faults(recording.rows, recording.rate_hz, recording.agents, later)
        if not bad.any():
            break
        findings.rows += int(bad.sum())
        recording = dataclasses.replace(recording, rows=select(recording.rows, ~bad))
        later = Findings(folder)  # what follows from leaving rows out is no finding of its own
    else:
        return None
    faults = len(findings.errors)
    check_places(recording, findings)
    _check_egos(recording, findings)
    return recording if len(findings.errors) == faults else None


def _check_egos(recording: Recording, findings: Findings) -> None:
    there = np.unique(recording.rows["agent"])
    if not len(there):
        findings.add("states.parquet", ": no row is left; there is nothing to import")
    elif not any(recording.agents[agent].ego for agent in there):
        findings.add(
            "episode.json",
            f", field 'agents[*].ego': none of the {len(there)} agents may be ego, so no frame can be made; "
            "write true for those whose driving is to be learnt",
        )
