"""A report's tables as Markdown, for a README or a pull request: the numbers of the PDF, in the same rounding."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any
from urllib.parse import quote

from study.claims import MINUS

Numbers = Mapping[str, Any]
NOTHING = "\N{EM DASH}"
SHARE_WORDS = (
    "Ceiling: policies that are given the true state in the place of a latent. Share of gain: a score's part of the "
    "way from the commonest class to there (acceleration only, since the state holds no route)."
)
LOSS = f"10<sup>{MINUS}3</sup>"
UNIT_WORDS = {"points": " points", "loss": f" · {LOSS}", "epochs": "", "ratio": ""}


def written(made: Numbers) -> str:
    """The Markdown of a report.json: verdicts, scores, contrasts, convergence, confounds, spread, cost, provenance."""
    parts = [
        f"## {plain(made['sweep']['title'])}",
        _lead(made),
        _verdicts(made),
        _scores(made),
        _contrasts(made),
        _convergence(made),
        _confounds(made),
        _components(made),
        _cost(made),
        _provenance(made),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


# --- pieces ---------------------------------------------------------------------------------------------------------


def plain(text: object) -> str:
    """Words from outside as they are: no markup, no new row, no new cell."""
    words = " ".join(str(text).split())
    for sign in "\\`*_[]|~#":
        words = words.replace(sign, f"\\{sign}")
    return words.replace("&", "&amp;").replace("<", "&lt;")


def code(text: object) -> str:
    """Words from outside in fixed width."""
    return f"`{' '.join(str(text).split()).replace('`', ' ').replace('|', ' ')}`"


def picture(file: str, alt: str, caption: str) -> str:
    """A picture with its caption; a PDF, which pages do not show inside, as a link."""
    shown = "" if file.lower().endswith(".pdf") else "!"
    return f"{shown}[{plain(alt)}]({quote(file)})\n\n*{plain(caption)}*"


def rows(header: Sequence[str], body: Iterable[Sequence[str]], left: int = 1) -> str:
    """A table: its first `left` columns to the left, the others to the right. Empty without a row."""
    lines = [f"| {' | '.join(row)} |" for row in body]
    if not lines:
        return ""
    line = "|".join("---" if index < left else "--:" for index in range(len(header)))
    return "\n".join([f"| {' | '.join(header)} |", f"|{line}|", *lines])


def fixed(value: float | str | None, digits: int, factor: float = 1.0, *, sign: bool = False) -> str:
    """A number of a report.json: None is a dash, "never" stays."""
    if value is None or isinstance(value, str):
        return value or NOTHING
    shown = f"{abs(factor * value):.{digits}f}"
    zero = not shown.strip("0.")
    return ("" if zero else MINUS if value < 0 else "+" if sign else "") + shown


def by_unit(value: float | str | None, unit: str) -> str:
    """A finding's number in the unit that reports print."""
    if unit == "points":
        return fixed(value, 2, 100, sign=True)
    if unit == "loss":
        return fixed(value, 3, 1e3, sign=True)
    return fixed(value, 0 if unit == "epochs" else 2)


def between(low: str, high: str) -> str:
    """An interval of two shown numbers."""
    return NOTHING if low == NOTHING else f"{low} to {high}" if low != high or low != "never" else low


def clock(seconds: float | None) -> str:
    """A time span."""
    if seconds is None:
        return NOTHING
    return f"{seconds:.0f} s" if seconds < 100 else f"{seconds / 60:.1f} min"


def probability(p: float | None) -> str:
    """A p value."""
    return NOTHING if p is None else "< 0.0001" if p < 0.0001 else f"{p:.4f}"


def found(finding: Numbers) -> str:
    """A finding: its number, its 95 % interval, n and what followed."""
    unit, estimate = finding["unit"], finding["estimate"]
    low, high = (by_unit(estimate[end], unit) for end in ("low", "high"))
    return (
        f"{plain(finding['what'])}: {by_unit(estimate['value'], unit)}{UNIT_WORDS[unit]} "
        f"({between(low, high)}, n = {estimate['n']}), {finding['state']}"
    )


# --- parts ----------------------------------------------------------------------------------------------------------


def _lead(made: Numbers) -> str:
    own = made["sweep"]
    seeds = (
        f"{own['encoder_seeds']} encoder{'s' * (own['encoder_seeds'] != 1)} a cell, {own['policy_seeds']} policies each"
    )
    text = f"Sweep {code(own['name'])}, profile {code(own['profile'])}; {seeds}. Simulator: {plain(own['simulator'])}."
    if own["finished"] < own["planned"]:
        text += f" **Incomplete: {own['finished']} of {own['planned']} cells are finished.**"
    if own["design"] == "A":
        text += " Intervals are over the policies on one encoder a cell and say nothing about other encoders."
    else:
        text += " Intervals are over encoders."
    return text


def _verdicts(made: Numbers) -> str:
    body = [
        [
            claim["claim"],
            plain(claim["text"]),
            f"**{claim['outcome']}**",
            "<br>".join(found(item) for item in claim["findings"]) or plain(claim["reason"]),
        ]
        for claim in made["claims"]
    ]
    return rows(["Claim", "The text says", "Verdict", "Findings (95 % interval)"], body, left=4)


def _scores(made: Numbers) -> str:
    if not made["scores"]:
        return "No cell is finished."
    floor, ceiling = made["floor"], made["ceiling"]
    body = []
    for row in made["scores"]:
        steering = row["steering"]
        body.append(
            [
                plain(row["cell"]),
                *_accuracy(row["accuracy"]),
                *([fixed(row["share"], 0, 100)] if ceiling else []),
                fixed(row["balanced"]["mean"], 1, 100) if "balanced" in row else NOTHING,
                fixed(row["macro_f1"], 3),
                fixed(steering["mean"], 3, 1e3),
                between(*(fixed(steering[end], 3, 1e3) for end in ("low", "high"))),
            ]
        )
    if ceiling:
        body.append(["*ceiling (true state)*", *_accuracy(ceiling), fixed(1, 0, 100), *[NOTHING] * 4])
    kinds = "; ".join(dict.fromkeys(row["accuracy"]["kind"] for row in made["scores"]))
    text = (
        f"Final scores on test drives, mean of the last five epochs. Interval: {kinds}. Always saying the commonest "
        f"class gives {fixed(floor['accuracy'], 1, 100)} %, the best constant command a steering loss of "
        f"{fixed(floor['steering'], 3, 1e3)}."
    )
    if ceiling:
        text += f" {SHARE_WORDS}"
    header = [
        *("Cell", "n", "accuracy [%]", "sd", "95 %", "IQM"),
        *(["share of gain [%]"] if ceiling else []),
        *("balanced", "macro-F1", f"steering [{LOSS}]", "95 %"),
    ]
    return f"{text}\n\n{rows(header, body)}"


def _accuracy(spread: Numbers) -> list[str]:
    """n, mean, standard deviation, interval and interquartile mean."""
    return [
        str(spread["n"]),
        fixed(spread["mean"], 1, 100),
        fixed(spread["sd"], 2, 100),
        between(*(fixed(spread[end], 2, 100) for end in ("low", "high"))),
        fixed(spread["iqm"], 1, 100),
    ]


def _contrasts(made: Numbers) -> str:
    body = [
        [
            plain(row["name"]),
            str(row["difference"]["n"]),
            fixed(row["difference"]["value"], 2, 100, sign=True),
            between(*(fixed(row["difference"][end], 2, 100, sign=True) for end in ("low", "high"))),
            probability(row["p"]),
            probability(row["p_holm"]),
            fixed(row["improvement"], 2),
            fixed(row["detectable"], 2, 100),
            between(*(fixed((row["episodes"] or {}).get(end), 2, 100, sign=True) for end in ("low", "high"))),
        ]
        for row in made["comparisons"]
        if row["metric"] == "acceleration_accuracy"
    ]
    header = ["Contrast", "n", "points", "95 %", "p", "p, Holm", "P(better)", "detectable", "by drive"]
    table = rows(header, body)
    return table and (
        "Differences in final accuracy, paired by seed; exact sign-flip p, Holm over "
        f"{made['planned_contrasts']} planned contrasts; detectable with 80 % power; interval over test "
        f"drives.\n\n{table}"
    )


def _convergence(made: Numbers) -> str:
    listed = made["convergence"]
    body = [
        [
            plain(row["cell"]),
            str(row["n"]),
            fixed(row["mean_curve"]["value"], 0),
            between(*(fixed(row["mean_curve"][end], 0) for end in ("low", "high"))),
            fixed(row["median"], 0),
            fixed(row["share"], 0, 100),
            fixed(row["area"], 1, 100),
        ]
        for row in listed
    ]
    table = rows(["Cell", "n", "mean curve", "95 %", "median by seed", "share [%]", "area [%]"], body)
    own = made["sweep"]
    return table and (
        f"Epochs to reach the final accuracy of {own['baseline']}, {fixed(listed[0]['target'], 1, 100)} %: of the mean "
        "curve; by seed with a trailing mean that stays (Kaplan-Meier); share of the seeds that do. Area: mean "
        f"accuracy over all {own['policy_epochs']} epochs.\n\n{table}"
    )


def _confounds(made: Numbers) -> str:
    seen = [row for row in made["confounds"] if row["contrasts"]]
    pairs = [(row, contrast) for row in seen for contrast in row["contrasts"]]
    body = []
    for row, contrast in pairs:
        own = [
            (by_unit(one["value"], "points"), between(*(by_unit(one[end], "points") for end in ("low", "high"))))
            for one in (contrast["here"], contrast["there"], contrast["change"])
        ]
        body.append(
            [
                code(row["setting"]),
                plain(row["here"]),
                plain(row["there"]),
                plain(contrast["name"]),
                f"{contrast['here']['n']}, {contrast['there']['n']}",
                *(cell for found in own for cell in found),
                contrast["state"],
            ]
        )
    header = ["Setting", "here", "there", "Contrast", "n", "points here", "95 %", "points there", "95 %"]
    table = rows([*header, "change", "95 %", ""], body, left=4)
    kinds, changes = (
        "; ".join(dict.fromkeys(contrast[name]["kind"] for _, contrast in pairs)) for name in ("here", "change")
    )
    others = ", ".join(
        f"{code(row['setting'])} in {code(row['sweep'])} (floor {fixed(row['floor'], 1, 100)} %)" for row in seen
    )
    return table and (
        "Confounds: differences in final accuracy under both values of a setting, paired by seed, all else the same. "
        f"There: {others}; the floor here is {fixed(made['floor']['accuracy'], 1, 100)} %. Interval: {kinds}; of the "
        f"change: {changes}. Moved: the change's interval, widened by the allowance for other encoders where a cell "
        f"has one, excludes 0.\n\n{table}"
    )


def _components(made: Numbers) -> str:
    names = ("encoder", "policy", "epoch")
    body = [[plain(row["cell"]), *(fixed(row[name], 2, 100) for name in names)] for row in made["components"]]
    table = rows(["Cell", *(f"{name}{' seed' * (name != 'epoch')}" for name in names)], body)
    return table and f"Where the spread of accuracy comes from: standard deviations in points.\n\n{table}"


def _cost(made: Numbers) -> str:
    stages = ("encoder", "encode", "policies", "whole")
    body = [
        [
            plain(row["cell"]),
            *(clock(row[stage]) for stage in stages),
            plain(", ".join(str(row[name]) for name in ("device", "precision") if row[name] is not None)) or NOTHING,
        ]
        for row in made["cost"]["cells"]
    ]
    table = rows(["Cell", "encoder", "latents", "policies", "whole cell", "device"], body)
    return table and f"Wall time: {clock(made['cost']['seconds'])} for all finished cells.\n\n{table}"


def _provenance(made: Numbers) -> str:
    own = made["provenance"]
    commit = "unknown" if own["commit"] is None else code(own["commit"])
    changed = " with uncommitted changes" * bool(own["dirty"])
    packages = ", ".join(f"{plain(name)} {plain(version)}" for name, version in own["packages"].items())
    return (
        f"Commit {commit}{changed}; data {code(made['data']['key'])}; Python {plain(own['python'])}; {packages}; "
        f"{plain(own['cpu'])}, {own['cores']} cores."
    )
