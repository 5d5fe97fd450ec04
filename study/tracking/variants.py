"""Find the sweeps that differ from another in one confound alone."""

from __future__ import annotations

from dataclasses import replace

from study.analysis.confounds import contrasts, varied
from study.errors import BadInputError
from study.results.sweep_record import SweepRecord
from study.tracking.experiment import TrackerLostError, UnreadableError
from study.tracking.reader import Reader


def with_variants(reader: Reader, record: SweepRecord) -> SweepRecord:
    """Return a sweep with, by setting, the latest one of its profile that differs from it in that confound alone.

    Settings do not say where drives come from: those of a study on imported drives may be our town's.
    Sweeps that cannot be read are named in `unread` and left out.
    """
    variants: dict[str, SweepRecord] = {}
    unread = list(record.unread)
    for run in reversed(reader.sweep_runs()):
        if run.data.tags.get("profile") != record.profile or run.info.run_id == record.run_id:
            continue
        try:
            confound = varied(record.settings, reader.read_settings(run.info.run_id))
            if confound is None or confound.setting in variants:
                continue
            variant = reader.read_sweep_run(run.info.run_id)
        except TrackerLostError:
            raise
        except UnreadableError as error:
            unread.append(f"sweep {run.info.run_name}, to compare with: {error}")
            continue
        except BadInputError:  # planned by another version: nothing to compare with
            continue
        unread += [f"sweep {run.info.run_name}, to compare with: {line}" for line in variant.unread]
        if _imported(variant) == _imported(record) and contrasts(record, variant, confound):
            variants[confound.setting] = variant
    return replace(record, variants=variants, unread=tuple(dict.fromkeys(unread)))


def _imported(record: SweepRecord) -> set[str]:
    """Return the digests of imported drives; nothing for our town's, which the settings define."""
    sources = record.data.get("sources", {}) if record.data.get("writers") else {}
    return {drive["digest"] for drives in sources.values() for drive in drives}
