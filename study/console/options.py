"""What the commands share: click options derived from settings models, clear errors, exit codes."""

from __future__ import annotations

import atexit
import functools
import io
import os
import shlex
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any, NoReturn

import click
import yaml
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from study.config.files import named_files
from study.config.workspace import HERE
from study.console.interrupts import EXITS_AT_ONCE
from study.errors import EXIT_BAD_INPUT, BadInputError, masked, write_failure

Decorator = Callable[[Callable[..., Any]], Any]


class YamlValue(click.ParamType[Any]):
    """A value in YAML's notation, as in a profile: `5`, `[rec, full]`, `{plan: 5}`."""

    name = "value"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Parse the text; the settings check its type when profile and sweep file are known."""
        try:
            return yaml.safe_load(value)
        except yaml.YAMLError:
            self.fail(
                f"'{value}' is not valid YAML; give a value as in a profile, such as 5 or [rec, full]", param, ctx
            )


def settings_options(model: type[BaseModel], names: Iterable[str] = ()) -> list[Decorator]:
    """Derive an option from each field of a settings model, or from `names` of them; `--group.field` in nested models.

    Their values are checked by the model when they are merged with the profile, since heads may come with the sweep.
    """
    fields: dict[str, FieldInfo] = {}
    for name in names or model.model_fields:
        kind = model.model_fields[name].annotation
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            fields |= {f"{name}.{inner}": info for inner, info in kind.model_fields.items()}
        else:
            fields[name] = model.model_fields[name]
    return [
        click.option(f"--{name}", name.replace(".", "__"), type=YamlValue(), metavar="V", help=_help(info))
        for name, info in fields.items()
    ]


def _help(info: FieldInfo) -> str:
    default = None if info.is_required() else info.get_default(call_default_factory=True)
    return f"{info.description or ''}{'' if default is None else f' [{default}]'}"


def nested(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings that were given, as a profile nests them."""
    settings: dict[str, Any] = {}
    for name, value in values.items():
        group, _, field = name.rpartition("__")
        if value is not None:
            (settings.setdefault(group, {}) if group else settings)[field] = value
    return settings


def bundled(parameter: str, build: Callable[..., Any], *options: Decorator) -> Decorator:
    """Give a command some options; it gets what `build` makes of their values as one parameter."""

    def decorate(command: Callable[..., Any]) -> Any:
        @functools.wraps(command)
        def call(**values: Any) -> Any:
            built = build(**{name: values.pop(name) for name in names})
            return command(**values, **{parameter: built})

        for option in reversed(options):
            option(call)
        return call

    names = [each.name for option in options for each in click.command("probe")(option(lambda: None)).params]
    return decorate


def profile_option() -> Decorator:
    """Name the profile."""
    names = ", ".join(named_files(HERE.profiles))
    return click.option("--profile", default="laptop", metavar="P", help=f"{names} [laptop]")


def tracking_option() -> Decorator:
    """Name the store of results."""
    return click.option("--tracking", default=HERE.tracking, metavar="URI", help=f"MLflow store [{HERE.tracking}]")


def invoke(
    default: click.Command,
    args: Sequence[str],
    program: str,
    commands: Mapping[str, click.Command] = MappingProxyType({}),
    hint: str = "",
) -> int:
    """Run the command that the first word names, else `default`, and return its exit code.

    The command's context holds the command line as its object. Raises BadInputError for words that it does not take;
    of an option it says which of the commands take it, or else gives the hint.
    """
    command, words, path = default, list(args), f"python -m {program}"
    if words and words[0] in commands:
        command, path = commands[words[0]], f"{path} {words.pop(0)}"
    try:
        with command.make_context(path, words, obj=masked(f"{path} {shlex.join(words)}")) as context:
            return int(command.invoke(context))
    except click.exceptions.Exit as end:  # after --help
        return end.exit_code
    except click.NoSuchOption as error:
        path = error.ctx.command_path if error.ctx else path
        named = {f"python -m {program}": default} | {f"python -m {program} {name}": commands[name] for name in commands}
        step = _takers(error.option_name, named) or hint
        raise BadInputError(
            "; ".join(filter(None, [error.format_message().rstrip("."), step, f"see {path} --help"]))
        ) from None
    except click.UsageError as error:
        path = error.ctx.command_path if error.ctx else path
        raise BadInputError(f"{error.format_message().rstrip('.')}; see {path} --help") from None


def _takers(option: str, commands: Mapping[str, click.Command]) -> str:
    """Return in words which commands show this option in their help; empty when none does."""
    single: dict[str, click.Command] = {}
    for path, command in commands.items():
        groups = command.commands if isinstance(command, click.Group) else {"": command}
        single |= {f"{path} {name}".strip(): each for name, each in groups.items()}
    names = [
        path
        for path, command in single.items()
        if any(option in each.opts and not getattr(each, "hidden", False) for each in command.params)
    ]
    return f"it goes with {', '.join(names)}: leave it out here" if names else ""


def _spare_cache() -> None:
    """Name a folder for matplotlib where the home cannot be written.

    Its own spare one, once swept, ends in a traceback. Processes that this one starts have the same.
    """
    usual = Path(os.environ.get("XDG_CONFIG_HOME") or os.path.expanduser("~/.config"), "matplotlib")  # noqa: PTH111
    there = next(path for path in (usual, *usual.absolute().parents) if os.path.exists(path))  # noqa: PTH110
    if "MPLCONFIGDIR" in os.environ or (there.is_dir() and os.access(there, os.W_OK)):
        return
    with suppress(OSError):  # then whoever needs the folder says so
        folder = tempfile.mkdtemp(prefix="study-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        os.environ["MPLCONFIGDIR"] = folder


def run(main: Callable[[Sequence[str]], int]) -> NoReturn:
    """Run a command's main function; bad input is one line on stderr and exit code 2.

    A character that the output cannot show is a substitute there.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")
    _spare_cache()
    try:
        code = main(sys.argv[1:])
    except BadInputError as error:
        print(f"error: {masked(str(error))}", file=sys.stderr)
        code = EXIT_BAD_INPUT
    except BrokenPipeError:  # the reader, such as `head`, has seen enough
        sys.stderr.close()
        code = 0
    except Exception as error:
        problem = write_failure(error)
        if problem is None:
            raise
        print(f"error: {masked(problem)}", file=sys.stderr)
        code = EXIT_BAD_INPUT
    if code in EXITS_AT_ONCE:  # Dask would wait for its workers, which end by themselves
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)
