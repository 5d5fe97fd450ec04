import re
import shutil
import subprocess
from pathlib import Path

import pytest

from study.document.blocks import Heading, Table, code, plain
from study.document.latex import inline, latex
from study.document.markdown import markdown
from study.report import __main__
from study.report.comparison import compare
from study.report.model import read_report
from study.report.text import document
from tests.support.processes import ROOT

REFERENCES = ROOT / "reports/reference"
ENGINES = {
    "pdflatex": ["-interaction=nonstopmode", "-halt-on-error"],
    "xelatex": ["-interaction=nonstopmode", "-halt-on-error"],
    "tectonic": [],
}
PREAMBLE = r"\documentclass{article}\usepackage{array, booktabs, longtable}\begin{document}"
COMMAND = re.compile(r"\\([a-zA-Z]+|.)")
HOSTILE = r"""a & 50 % # $x_1$ {b} ~ ^ \def\x{} "q" 'r' [s] | <t> --- ,, * `u` é"""


@pytest.fixture(scope="module")
def documents():
    """Return documents of every kind by name: a small report, one with driving, and a comparison."""
    first, second = (read_report(REFERENCES / name) for name in ("heads", "heads-paper"))
    return {
        "heads": document(first),
        "datasize": document(read_report(REFERENCES / "datasize")),
        "both": compare(first, second, ("one", "other")),
    }


@pytest.fixture(scope="module", params=["heads", "datasize", "both"])
def blocks(request, documents):
    return documents[request.param]


def bodies(text):
    """Return the column specification and the lines of each tabular or longtable."""
    found = re.findall(r"\\begin\{(tabular|longtable)\}\{([^\n]*)\}\n(.*?)\\end\{\1\}", text, flags=re.DOTALL)
    return [(spec, body.splitlines()) for _, spec, body in found]


def columns(spec):
    return len(re.sub(r"p\{[^}]*\}", "p", re.sub(r">\{[^}]*\}", "", spec)))


def numbers(text):
    """Return the numbers of a text in order, each without sign, as both renderings write them."""
    return re.findall(r"\d+(?:\.\d+)?", text)


def test_environments_and_braces_are_balanced(blocks):
    text, opened = latex(blocks, "x"), []
    for kind, name in re.findall(r"\\(begin|end)\{(\w+)\}", text):
        if kind == "begin":
            opened.append(name)
        else:
            assert opened.pop() == name
    assert opened == []
    bare = re.sub(r"\\[{}]", "", text)
    assert bare.count("{") == bare.count("}") > 0
    assert text.count(r"\begingroup") == text.count(r"\endgroup")


def test_every_table_is_there_with_its_columns_caption_and_a_label_of_its_own(blocks):
    text, tables = latex(blocks, "x"), [block for block in blocks if isinstance(block, Table)]
    assert len(tables) == len(bodies(text)) > 5
    for table, (spec, lines) in zip(tables, bodies(text), strict=True):
        assert columns(spec) == len(table.align)
        rows = [line for line in lines if line.endswith(r"\\") and not line.startswith(r"\caption")]
        heads = (len(rows) - len(table.rows)) if any(table.header) else 0
        assert heads in ({1, 2} if any(table.header) else {0})
        assert {len(re.findall(r"(?<!\\)&", row)) for row in rows} == {len(table.align) - 1}
    labels = re.findall(r"\\label\{(tab:x:[a-z0-9-]+)\}", text)
    assert len(labels) == len(set(labels)) == len(tables)
    assert len(re.findall(r"\\caption\{\S", text)) == len(tables)


def test_no_character_is_left_that_latex_would_read(blocks):
    for _, lines in bodies(latex(blocks, "x")):
        for line in lines:
            bare = re.sub(r"\$[^$]*\$", "", COMMAND.sub("", line))
            assert re.findall(r"[%#$_^~<>|\"]", bare) == [], line
            assert bare.isascii(), line


def test_the_numbers_of_markdown_s_tables_are_there_in_their_order(blocks):
    rows = re.findall(r"^\|.*\|$", markdown(blocks), flags=re.MULTILINE)
    assert rows
    shown = numbers("\n".join(rows).translate(str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹", "0123456789")))
    tables = [Table(block.header, block.align, block.rows) for block in blocks if isinstance(block, Table)]
    text = latex([Heading(1, "none"), *tables], "none")
    once = re.sub(r"\\endfirsthead.*?\\endfoot", "", text, flags=re.DOTALL)  # the header, again
    body = "\n".join("\n".join(lines) for _, lines in bodies(once))
    assert numbers(re.sub(r"\\label\{.*\}|\\char34", "", body)) == shown


def test_marks_and_signs_become_those_of_latex():
    assert inline("**bold \\* and \\_**") == r"\textbf{bold * and \_}"
    assert inline("*true state* at `a_b --c`") == r"\emph{true state} at \texttt{a\_b -{}-c}"
    assert inline("\N{MINUS SIGN}1.2 \N{PLUS-MINUS SIGN} 3, 1\N{THIN SPACE}000") == r"$-$1.2 $\pm$ 3, 1\,000"
    assert (
        inline("\N{EM DASH}, 1\N{EN DASH}2, 10⁻³ µ₁₂ \N{GREEK SMALL LETTER ALPHA}")
        == r"---, 1--2, 10$^{-3}$ $\mu$$_{12}$ $\alpha$"
    )
    assert inline("one<br>two", r"\newline ") == r"one\newline two"
    assert inline('"so" \\~ \\\\ ^') == r"``so'' \textasciitilde{} \textbackslash{} \textasciicircum{}"
    assert inline("a\x1bb\ud800") == "a?b?"


def test_a_row_that_begins_with_a_bracket_is_no_option_of_the_row_above():
    rows = tuple((plain(word), plain("x")) for word in ("[1 pt]", "*", "[2 pt]"))
    ((_, lines),) = bodies(latex([Table(("a", "b"), "ll", rows)], "x"))
    assert lines[3:6] == [r"{}[1 pt] & x \\", r"{}* & x \\", r"{}[2 pt] & x \\"]


def test_long_tables_go_on_on_the_next_page_and_long_words_are_wrapped():
    rows = tuple((plain(f"row {number}"), plain("many words " * 9)) for number in range(60))
    text = latex([Table(("a", "b"), "lr", rows)], "x")
    assert text.count(r"\begin{longtable}{l>{\raggedleft\arraybackslash}p{") == 1
    assert r"\begin{table}" not in text


def engine():
    """Return a TeX engine that is there with the packages that tables need, or skip."""
    for name, options in ENGINES.items():
        if shutil.which(name):
            return [name, *options]
    pytest.skip(f"none of {', '.join(ENGINES)} is on this machine; the structure is checked all the same")


def test_tables_compile(documents, tmp_path):
    command = engine()
    hostile = Table((plain(HOSTILE), "b"), "lr", ((code(HOSTILE), plain(HOSTILE)),), plain(HOSTILE), plain(HOSTILE))
    for name, blocks in {**documents, "hostile": [hostile]}.items():
        file = tmp_path / f"{name}.tex"
        file.write_text(f"{PREAMBLE}\n{latex(blocks, name)}\n\\end{{document}}\n", encoding="utf-8")
        done = subprocess.run([*command, file.name], cwd=tmp_path, capture_output=True, check=False, timeout=120)
        assert done.returncode == 0, done.stdout[-2000:]
        assert (tmp_path / f"{name}.pdf").stat().st_size > 10_000
        log = tmp_path / f"{name}.log"
        if log.exists():
            assert re.findall(r"Missing character|Float too large|multiply defined", log.read_text("latin-1")) == []


def test_compare_prints_latex_and_writes_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sides = [str(Path(REFERENCES / name)) for name in ("heads", "heads-short")]
    assert __main__.main(["compare", *sides, "--format", "latex"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("% Tables of ")
    assert r"\toprule" in text
    assert list(tmp_path.iterdir()) == []
