"""The child's side of a cell: a process that trains it and tells its parent through a pipe.

Messages: ("device", name), ("log", stage, epoch, metrics), ("progress", stage, done, total), and last ("done",) or
("failed", whether another try may help, reason). Nothing here knows the tracker or the queue, so a child loads neither.
"""

from __future__ import annotations

import multiprocessing
import traceback
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext
from multiprocessing.process import BaseProcess

from study.command import deaf_to_interrupts, obey_parent
from study.config import BadInputError
from study.result import CellJob, TrainingDivergedError

NO_MEMORY = ("out of memory", "can't allocate memory")  # torch says so in RuntimeErrors, GPUs and CPUs each


def start(job: CellJob) -> tuple[BaseProcess, Connection]:
    """A process that runs the cell, and the end of its pipe."""
    here, there = multiprocessing.Pipe(duplex=False)
    # Not as a daemon, which may have no children: policies are trained in several processes.
    process = _fork_server().Process(target=_serve, args=(job, there), name=job.cell.label, daemon=False)
    process.start()
    there.close()
    return process, here


def _fork_server() -> ForkServerContext:
    """Where children come from: a process that loads torch once, so that each of them starts within a moment."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["study.cell", "study.child"])
    with deaf_to_interrupts():
        forkserver.ensure_running()
    return context


def _serve(job: CellJob, parent: Connection) -> None:
    obey_parent()
    try:
        from study.cell import choose_device, device_name, run_cell  # noqa: PLC0415 - the parent needs no torch

        parent.send(("device", device_name(choose_device(job))))
        run_cell(
            job,
            lambda *what: parent.send(("log", *what)),
            lambda *what: parent.send(("progress", *what)),
        )
    except (BadInputError, TrainingDivergedError) as error:
        parent.send(("failed", False, str(error)))
    except (OSError, MemoryError):
        parent.send(("failed", True, traceback.format_exc()))
    except Exception as error:  # noqa: BLE001 - whatever it is belongs to this cell, and the others go on
        passing = isinstance(error, RuntimeError) and any(words in str(error).lower() for words in NO_MEMORY)
        parent.send(("failed", passing, traceback.format_exc()))
    else:
        parent.send(("done",))
