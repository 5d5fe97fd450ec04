r"""The tables of a document as LaTeX, for a paper: booktabs rules, captions, labels.

The preamble needs array, booktabs and longtable, and nothing else. What LaTeX would read as a command is escaped. The
output is ASCII but for letters that the fonts of a paper have or have not: pdfLaTeX knows accented ones.
"""

from __future__ import annotations

import math
import re
import unicodedata
from collections.abc import Iterable, Sequence

from study.document.blocks import Block, Heading, Table

LONG = 36  # characters beyond which the words of a column are wrapped
LINE = 84  # characters of \small on a line of the article class
PAGE = 40  # lines beyond which a table goes on on the next page
INLINE = re.compile(r"`([^`]*)`|\*\*((?:\\.|[^*\\])+)\*\*|\*((?:\\.|[^*\\])+)\*|\\(.)|(<br>)")
SIDES = {"l": r"\raggedright", "c": r"\centering", "r": r"\raggedleft"}
SUPERSCRIPTS = dict(zip("⁰¹²³⁴⁵⁶⁷⁸⁹⁺⁻⁼⁽⁾ⁿ", "0123456789+-=()n", strict=True))
SUBSCRIPTS = dict(zip("₀₁₂₃₄₅₆₇₈₉₊₋₌₍₎", "0123456789+-=()", strict=True))
RUNS = re.compile(rf"[{''.join(SUPERSCRIPTS)}]+|[{''.join(SUBSCRIPTS)}]+|-+|,+|'+|.", re.DOTALL)
STRAIGHT = {'"': r"\char34{}", "'": r"\textquotesingle{}"}  # in fixed width
CHARACTERS = {
    "\\": r"\textbackslash{}",
    **{mark: f"\\{mark}" for mark in "&%$#_{}"},
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "`": r"\textasciigrave{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    "\N{MINUS SIGN}": "$-$",
    "\N{PLUS-MINUS SIGN}": r"$\pm$",
    "\N{MULTIPLICATION SIGN}": r"$\times$",
    "\N{MIDDLE DOT}": r"$\cdot$",
    "\N{DOT OPERATOR}": r"$\cdot$",
    "\N{LESS-THAN OR EQUAL TO}": r"$\leq$",
    "\N{GREATER-THAN OR EQUAL TO}": r"$\geq$",
    "\N{NOT EQUAL TO}": r"$\neq$",
    "\N{ALMOST EQUAL TO}": r"$\approx$",
    "\N{RIGHTWARDS ARROW}": r"$\rightarrow$",
    "\N{LEFTWARDS ARROW}": r"$\leftarrow$",
    "\N{SQUARE ROOT}": r"$\surd$",
    "\N{INFINITY}": r"$\infty$",
    "\N{DEGREE SIGN}": r"$^{\circ}$",
    "\N{MICRO SIGN}": r"$\mu$",
    "\N{NOT SIGN}": r"$\neg$",
    "\N{EN DASH}": "--",
    "\N{EM DASH}": "---",
    "\N{NON-BREAKING HYPHEN}": "-",
    "\N{HORIZONTAL ELLIPSIS}": r"\ldots{}",
    "\N{NO-BREAK SPACE}": "~",
    "\N{THIN SPACE}": r"\,",
    "\N{NARROW NO-BREAK SPACE}": r"\,",
    "\N{LEFT SINGLE QUOTATION MARK}": "`",
    "\N{RIGHT SINGLE QUOTATION MARK}": "'",
    "\N{LEFT DOUBLE QUOTATION MARK}": "``",
    "\N{RIGHT DOUBLE QUOTATION MARK}": "''",
    "\N{SECTION SIGN}": r"\S{}",
}
GREEK = {
    unicodedata.lookup(f"GREEK {case} LETTER {name.upper().replace('LAMBDA', 'LAMDA')}"): f"$\\{name}$"
    for case, names in (
        (
            "SMALL",
            "alpha beta gamma delta epsilon zeta eta theta iota kappa lambda mu nu xi pi rho sigma tau phi chi psi",
        ),
        ("SMALL", "omega"),
        ("CAPITAL", "Gamma Delta Theta Lambda Xi Pi Sigma Phi Psi Omega"),
    )
    for name in names.split()
}


def latex(blocks: Iterable[Block], name: str) -> str:
    r"""Return the tables of a document as LaTeX; a label is tab:NAME:HEADING, with a number from the second on."""
    labels: dict[str, int] = {}
    tables, heading = [], ""
    for block in blocks:
        if isinstance(block, Heading):
            heading = block.text
        elif isinstance(block, Table):
            label = f"tab:{_slug(name)}:{_slug(heading)}"
            labels[label] = labels.get(label, 0) + 1
            number = f"-{labels[label]}" if labels[label] > 1 else ""
            tables.append(_table(block, block.caption or heading, label + number))
    start = f"% Tables of {_slug(name)}. The preamble needs \\usepackage{{array, booktabs, longtable}}."
    return "\n\n".join([start, *tables]) + "\n"


def _table(block: Table, caption: str, label: str) -> str:
    widths = _widths(block)
    columns = "".join(
        f">{{{SIDES[side]}\\arraybackslash}}p{{{width:.2f}\\linewidth}}" if width else side
        for side, width in zip(block.align, widths, strict=True)
    )
    titles = [f"\\caption{{{inline(caption)}}}", f"\\label{{{label}}}"]
    header = [_row(block.header), r"\midrule"] if any(block.header) else []
    rows = [_row(row) for row in block.rows]
    notes = [f"\n\\medskip\n{inline(block.notes)}"] if block.notes else []
    if _lines(block, widths) + len(caption) / LINE > PAGE:
        begin, end = f"\\begin{{longtable}}{{{columns}}}", r"\end{longtable}"
        head = [" ".join(titles) + r" \\", r"\toprule", *header, r"\endfirsthead"]
        again = [r"\toprule", *header, r"\endhead", r"\bottomrule", r"\endfoot"]
        return "\n".join([r"\begingroup\small", begin, *head, *again, *rows, end, *notes, r"\endgroup"])
    begin, end = f"\\begin{{tabular}}{{{columns}}}", r"\end{tabular}"
    body = [r"\toprule", *header, *rows, r"\bottomrule"]
    start = [r"\begin{table}[htbp]", r"\centering\small"]
    return "\n".join([*start, *titles, begin, *body, end, *notes, r"\end{table}"])


def _widths(block: Table) -> list[float]:
    """Return the share of a line for each column that is wrapped, of what the others leave; 0 for these."""
    columns = list(zip(block.header, *block.rows, strict=True))
    lengths = [[len(cell) for cell in column] for column in columns]
    most = [max(column) for column in lengths]
    wrapped = [most[i] > LONG or any("<br>" in cell for cell in column) for i, column in enumerate(columns)]
    left = 1 - sum(most[i] + 3 for i, wide in enumerate(wrapped) if not wide) / LINE
    share = max(left, 0.3) - 0.04 * sum(wrapped)  # 0.04: the space between two columns
    weights = [math.sqrt(sum(column) + 1) if wide else 0 for column, wide in zip(lengths, wrapped, strict=True)]
    return [share * weight / (sum(weights) or 1) for weight in weights]


def _lines(block: Table, widths: Sequence[float]) -> float:
    """Return about how many lines the rows take; 1.3: ragged lines are not full."""
    return sum(
        max(1.0, *(1.3 * len(cell) / (LINE * width) for cell, width in zip(row, widths, strict=True) if width), 0.0)
        for row in block.rows
    )


def _row(cells: Sequence[str]) -> str:
    words = " & ".join(inline(cell, r"\newline ") for cell in cells)
    return f"{'{}' if words.startswith(('[', '*')) else ''}{words} \\\\"  # else the row's end before would take it


def inline(text: str, line: str = " ") -> str:
    """Return inline Markdown as LaTeX; `line` is what a new line becomes."""
    parts, at = [], 0
    for found in INLINE.finditer(text):
        parts.append(_words(text[at : found.start()]))
        code, bold, italic, escaped, _ = found.groups()
        if code is not None:
            parts.append(f"\\texttt{{{_words(code, code=True)}}}")
        elif bold or italic:
            parts.append(f"\\{'textbf' if bold else 'emph'}{{{inline(bold or italic, line)}}}")
        else:
            parts.append(_words(escaped) if escaped else line)
        at = found.end()
    return "".join([*parts, _words(text[at:])])


def _words(text: str, *, code: bool = False) -> str:
    """Return words as LaTeX shows them: none of their characters is a command, and no two make a ligature."""
    text = unicodedata.normalize("NFC", text)
    if not code:
        text = re.sub(r'(^|[\s(\[])"', "\\1\N{LEFT DOUBLE QUOTATION MARK}", text)
        text = text.replace('"', "\N{RIGHT DOUBLE QUOTATION MARK}")
    return "".join(_shown(run[0], code) for run in RUNS.finditer(text))


def _shown(run: str, code: bool) -> str:
    """Return a character, or a run of hyphens, commas or apostrophes, of superscripts or of subscripts."""
    if run[0] in SUPERSCRIPTS or run[0] in SUBSCRIPTS:
        shifted = "".join((SUPERSCRIPTS | SUBSCRIPTS)[mark] for mark in run)
        return f"${'^' if run[0] in SUPERSCRIPTS else '_'}{{{shifted}}}$"
    if code and run[0] in STRAIGHT:
        return STRAIGHT[run[0]] * len(run)
    if len(run) > 1:
        return "{}".join(run)
    if unicodedata.category(run) in {"Cc", "Cs", "Cf"}:
        return "?"
    return CHARACTERS.get(run, GREEK.get(run, run))


def _slug(text: str) -> str:
    """Return words as a label has them: lower-case ASCII letters, digits and hyphens."""
    letters = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode().lower()
    return re.sub(r"[^a-z0-9]+", "-", letters).strip("-") or "table"
