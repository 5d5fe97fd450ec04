"""The data stage: drives from the town (Sec. IV-A) or from elsewhere, then the frame store that the cells read.

Drives and frames carry their key in their path, so what is there is used again.

python -m study.data build --profile laptop
python -m study.data card
python -m study.data preview
python -m study.data convert sumo|commonroad|highd SOURCE... --out DIR
python -m study.data import DIR
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from pkgutil import resolve_name  # the work is imported when it begins: --help needs none of it
from typing import Any

import click

from study.compute.provenance import cores
from study.config.files import load_profile
from study.config.settings import StudySettings
from study.config.workspace import HERE
from study.console.options import Decorator, bundled, invoke, nested, profile_option, run, settings_options


def _settings(profile: str, **values: Any) -> StudySettings:
    return load_profile(profile, nested(values))


def data_settings(*groups: str) -> Decorator:
    """Take a profile, and the settings of these groups; the command gets the `settings`."""
    return bundled("settings", _settings, profile_option(), *settings_options(StudySettings, groups))


workers = click.option(
    "--workers", type=click.IntRange(min=1), default=cores(), metavar="N", help="processes [all cores]"
)


@click.group(no_args_is_help=False)
def data() -> None:
    """Make the data of a study, describe it, and show it."""


@data.command
@data_settings("town", "recording")
@workers
def record(settings: StudySettings, workers: int) -> int:
    """Record the drives alone: they are small, and can be rendered on another machine."""
    return int(resolve_name("study.data.commands:record")(settings, workers, HERE))


def _frames_command(name: str, text: str) -> None:
    """Add a command that makes the frame store first, whatever of it is missing."""

    @data.command(name, help=text)
    @data_settings("town", "recording", "birdview", "frames")
    @click.option("--data", "source", type=Path, metavar="FOLDER", help="imported drives [those of our town]")
    @workers
    def command(settings: StudySettings, source: Path | None, workers: int) -> int:
        return int(resolve_name("study.data.commands:build")(name, settings, workers, HERE, source))


_frames_command("build", "Record the drives and render the frames, whatever of them is missing.")
_frames_command("card", "Show what is in the data: PNG and text beside the frame store.")
_frames_command("preview", "Draw frames and an animated drive, beside the frame store.")


@data.command("import")
@click.argument("folder", metavar="DIR", type=Path)
@click.option("--out", type=Path, metavar="FOLDER", help="where the adapted drives go [data/imported/<name of DIR>]")
@click.option("--check", is_flag=True, help="print all that is wrong, and import nothing")
@click.option("--drop-bad", is_flag=True, help="leave out what is bad, and say how much")
def import_(folder: Path, out: Path | None, check: bool, drop_bad: bool) -> int:  # noqa: FBT001
    """Check and adapt the Episodes in DIR, so that `study.sweep NAME --data FOLDER` can use them."""
    if check:
        return int(resolve_name("study.data.commands:check_folder")(folder))
    return int(resolve_name("study.data.commands:import_folder")(folder, out, HERE, drop_bad))


@data.group(no_args_is_help=False)
def convert() -> None:
    """Write recordings and scenarios of others as Episodes, to import (docs/extend/convert.md)."""


SECONDS = click.FloatRange(min=0, min_open=True)


def _converter(name: str, sources: str, *options: Decorator) -> Decorator:
    """Give `convert` a command that calls the function `convert` of a module in `study.convert`."""
    common: tuple[Decorator, ...] = (
        click.argument("sources", metavar=sources, type=Path, nargs=-1, required=True),
        click.option("--out", type=Path, metavar="DIR", required=True, help="a new folder for the drives"),
        click.option("--cut", type=SECONDS, default=60.0, metavar="S", help="length of the drives, about [60 s]"),
    )

    def decorate(describe: Callable[..., Any]) -> Any:
        def command(**values: Any) -> int:
            return int(resolve_name("study.data.commands:convert")(name, **values))

        for option in reversed((*common, *options)):
            command = option(command)
        return convert.command(name, help=describe.__doc__)(command)

    return decorate


def _files(name: str, text: str) -> Decorator:
    return click.option(name, type=Path, multiple=True, metavar="FILE", help=f"{text}; may be given again")


@_converter(
    "sumo",
    "SCENARIO.sumocfg...|NET.net.xml",
    _files("--fcd", "fcd-output of vehicles on the net"),
    _files("--routes", "with --fcd: vehicle types and routes"),
    click.option("--tls-states", type=Path, metavar="FILE", help="with --fcd: SaveTLSStates output"),
    click.option("--lights/--no-lights", default=True, help="the net's traffic lights"),
    click.option("--drives", type=click.IntRange(min=1), default=1, metavar="N", help="runs, seeds from 0 on [1]"),
    click.option("--warm-up", type=click.FloatRange(min=0), default=0.0, metavar="S", help="run first [0 s]"),
    click.option("--seconds", type=SECONDS, default=60.0, metavar="S", help="then recorded of each run [60 s]"),
)
def _sumo() -> None:
    """Run scenarios of Eclipse SUMO, or read the FCD output of a net."""


@_converter("commonroad", "SCENARIO.xml...")
def _commonroad() -> None:
    """Read scenarios of CommonRoad, XML 2020a."""


@_converter(
    "highd",
    "XX_tracks.csv...|FOLDER",
    click.option("--map", "maps", type=Path, multiple=True, metavar="FILE", help="lanelet2 .osm: one, or one for each"),
)
def _highd() -> None:
    """Read recordings in the CSV layout of highD, inD, rounD and exiD."""


def main(args: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    return invoke(data, args, "study.data")


if __name__ == "__main__":
    run(main)
