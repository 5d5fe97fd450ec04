"""Find the sweeps that differ from another in one confound alone."""

from __future__ import annotations

from study.analysis.confounds import contrasts, varied
from study.errors import BadInputError
from study.results.sweep_record import SweepRecord
from study.tracking.reader import Reader


def read_variants(reader: Reader, record: SweepRecord) -> dict[str, SweepRecord]:
    """Return, by setting, the latest sweep of the same profile that differs from this one in that confound alone."""
    variants: dict[str, SweepRecord] = {}
    for run in reversed(reader.sweep_runs()):
        if run.data.tags.get("profile") != record.profile:
            continue
        try:
            confound = varied(record.settings, reader.read_settings(run.info.run_id))
            if confound is None or confound.setting in variants:
                continue
            variant = reader.read_sweep_run(run.info.run_id)
        except BadInputError:  # planned by another version, or damaged: nothing to compare with
            continue
        if contrasts(record, variant, confound):
            variants[confound.setting] = variant
    return variants
