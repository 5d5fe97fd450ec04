"""The console script `study`: `study sweep heads` is `python -m study.sweep heads`, and so are `data` and `report`."""

from __future__ import annotations

import runpy
import sys

COMMANDS = {
    "sweep": "run a sweep to its report",
    "data": "record, build, check and show data",
    "report": "write reports",
}


def main() -> None:
    """Run the command that the first word names, with the words after it."""
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    if name in COMMANDS:
        del sys.argv[1]
        runpy.run_module(f"study.{name}", run_name="__main__", alter_sys=True)
        return
    listing = "\n".join(f"  study {command:<8}{purpose}" for command, purpose in COMMANDS.items())
    known = name in {"-h", "--help"}
    problem = "" if known else f"error: unknown command '{name}'; choose from {', '.join(COMMANDS)}\n\n"
    print(f"{problem}usage: study COMMAND ...\n\n{listing}", file=sys.stdout if known else sys.stderr)
    sys.exit(0 if known else 2)


if __name__ == "__main__":
    main()
