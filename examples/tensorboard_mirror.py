"""Mirror a sweep's curves to TensorBoard, beside MLflow. See docs/trackers.md.

python -m examples.tensorboard_mirror heads --follow 10
tensorboard --logdir data/tensorboard
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

import click
from torch.utils.tensorboard import SummaryWriter

from examples.follow_sweep import follow
from study.config.workspace import HERE
from study.console.options import invoke, run, tracking_option


@click.command
@click.argument("name", metavar="NAME")
@click.option("--profile", metavar="P", help="profile of the sweep [the latest run]")
@click.option("--out", type=Path, default=HERE.data / "tensorboard", metavar="DIR", help="[data/tensorboard]")
@click.option(
    "--follow", "seconds", type=click.FloatRange(min=0, min_open=True), metavar="S", help="every S seconds [once]"
)
@tracking_option()
def mirror(*, name: str, profile: str | None, out: Path, seconds: float | None, tracking: str) -> int:
    """Write the curves of the sweep NAME as event files: one folder for each attempt at a cell."""
    writers: dict[str, SummaryWriter] = {}
    with ExitStack() as stack, suppress(KeyboardInterrupt):  # Ctrl-C is how following usually ends
        for cell_run, points in follow(name, tracking, profile=profile, seconds=seconds):
            run_id, tags = cell_run.info.run_id, cell_run.data.tags
            if run_id not in writers:
                label = cell_run.info.run_name.partition(" (attempt ")[0]  # MLflow's name changes with the next attempt
                folder = (
                    out / tags["sweep"] / (label if tags["attempt"] == "1" else f"{label} attempt {tags['attempt']}")
                )
                # `purge_step`: TensorBoard forgets what an earlier mirror has written there.
                writers[run_id] = stack.enter_context(SummaryWriter(folder, purge_step=0))
                writers[run_id].add_text("settings", _table(cell_run.data.params), 0)
            for point in points:
                writers[run_id].add_scalar(point.key, point.value, point.step, point.timestamp / 1000)
            writers[run_id].flush()
    print(f"{len(writers)} runs in {out}; see them with: tensorboard --logdir {out}")
    return 0


def _table(params: dict[str, str]) -> str:
    return "\n".join(["| setting | value |", "|---|---|", *(f"| {key} | {value} |" for key, value in params.items())])


def main(args: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    return invoke(mirror, args, "examples.tensorboard_mirror")


if __name__ == "__main__":
    run(main)
