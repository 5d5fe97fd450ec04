"""What the commands share: options made from the settings, clear errors, exit codes."""

from __future__ import annotations

import argparse
import difflib
import os
import shlex
import sys
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import yaml
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from study.config.grid import Grid
from study.config.settings import StudySettings
from study.config.workspace import DEFAULT_TRACKING
from study.console.interrupts import EXITS_AT_ONCE
from study.errors import EXIT_BAD_INPUT, BadInputError, masked

GRID_OPTIONS = ("heads", "fractions", "encoder_seeds", "policy_seeds", "baseline", "ceiling")


class Parser(argparse.ArgumentParser):
    """An ArgumentParser that names the nearest option when it meets an unknown one."""

    def parse(self, args: Sequence[str]) -> argparse.Namespace:
        """Parse, or exit with code 2 and a message."""
        known, unknown = self.parse_known_args(args)
        if unknown:
            options = [word for word in self.format_help().split() if word.startswith("--")]
            near = difflib.get_close_matches(unknown[0].split("=")[0], options, n=1, cutoff=0.5)
            hint = f"; did you mean {near[0]}?" if near else ""
            self.error(f"unknown setting or word '{unknown[0]}'{hint}")
        return known

    def error(self, message: str) -> NoReturn:
        """Print the message without the long usage, and exit with code 2."""
        self.exit(EXIT_BAD_INPUT, f"error: {masked(message)}\nSee python -m {self.prog} --help\n")


def _value(text: str) -> Any:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise argparse.ArgumentTypeError(f"'{text}' is not valid YAML") from error


def add_options(parser: argparse.ArgumentParser, model: type[BaseModel], names: Sequence[str] = ()) -> None:
    """An option for each field of a settings model, `--group.field` where models nest; those not given stay unset."""
    group = parser.add_argument_group("grid" if model is Grid else "settings")
    for name in names or model.model_fields:
        info = model.model_fields[name]
        kind = info.annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            group = parser.add_argument_group(name, (kind.__doc__ or "").split("\n", maxsplit=1)[0])
            for inner, detail in kind.model_fields.items():
                _add(group, f"{name}.{inner}", detail)
        else:
            _add(group, name, info)


def _add(group: Any, name: str, info: FieldInfo) -> None:
    default = info.get_default(call_default_factory=True) if not info.is_required() else None
    usual = "" if default is None else f" [{default}]"
    # A percent sign in argparse's help is a format character.
    text = f"{info.description or name}{usual}".replace("%", "%%")
    group.add_argument(f"--{name}", metavar="V", type=_value, default=argparse.SUPPRESS, help=text)


def add_tracking_option(parser: argparse.ArgumentParser) -> None:
    """Where the results are kept."""
    parser.add_argument(
        "--tracking", default=DEFAULT_TRACKING, metavar="URI", help="MLflow store (default: %(default)s)"
    )


def given(options: argparse.Namespace, names: Sequence[str]) -> dict[str, Any]:
    """The settings that were given on the command line, nested, for the top-level names."""
    nested: dict[str, Any] = {}
    for name, value in vars(options).items():
        group, _, inner = name.partition(".")
        if group not in names:
            continue
        if inner:
            nested.setdefault(group, {})[inner] = value
        else:
            nested[group] = [value] if group in ("heads", "fractions") and not isinstance(value, list) else value
    return nested


def study_overrides(options: argparse.Namespace) -> dict[str, Any]:
    """Overrides of a profile."""
    return given(options, tuple(StudySettings.model_fields))


def grid_overrides(options: argparse.Namespace) -> dict[str, Any]:
    """Overrides of a sweep file."""
    return given(options, GRID_OPTIONS)


def run(main: Callable[[Sequence[str]], int]) -> NoReturn:
    """Run a command's main function; bad input is one line on stderr and exit code 2."""
    try:
        code = main(sys.argv[1:])
    except BadInputError as error:
        print(f"error: {masked(str(error))}", file=sys.stderr)
        code = EXIT_BAD_INPUT
    except BrokenPipeError:  # the reader, such as `head`, has seen enough
        sys.stderr.close()
        code = 0
    if code in EXITS_AT_ONCE:  # Dask would wait for its workers, which end by themselves
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def typed(module: str, args: Sequence[str]) -> str:
    """The command line again, for people, without credentials."""
    return masked(shlex.join(["python", "-m", module, *args]))
