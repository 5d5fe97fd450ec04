"""What is drawn on a terminal, with rich."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from typing import TypeVar

from rich.console import Console
from rich.live import Live
from rich.progress import track
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

Item = TypeVar("Item")


def print_table(rows: Sequence[Sequence[str]], styles: Sequence[str]) -> None:
    """Print rows of columns, each row in its style (rich's names)."""
    table = Table.grid(padding=(0, 2))
    for row, style in zip(rows, styles, strict=True):
        table.add_row(*map(Text, row), style=style)
    Console().print(table)


def bars(rows: Iterable[tuple[str, float, str]], *, title: str, share: float, summary: str) -> Table:
    """Return a table with a bar for each (label, share that is done, state), and one for all of them."""
    table = Table.grid(padding=(0, 2))
    for label, done, state in rows:
        table.add_row(Text(label), ProgressBar(total=1.0, completed=done, width=30), Text(state))
    table.add_row(Text(title, style="bold"), ProgressBar(total=1.0, completed=share, width=30), Text(summary))
    return table


def live_part() -> Live | None:
    """Return the part of the terminal that is drawn again and again, or None where stderr is no terminal."""
    console = Console(file=sys.stderr)
    return Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else None


def follow(items: Iterable[Item], count: int, words: str) -> Iterable[Item]:
    """Return the items, and show on stderr how many of `count` are through and how long the others will take."""
    return track(items, words, count, console=Console(file=sys.stderr), transient=True)
