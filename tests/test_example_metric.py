"""A metric, added by one function and its record, goes to the PDF, report.json and a comparison."""

import json

import numpy as np
import pytest
from pypdf import PdfReader

from examples.metric import MISSED_BRAKES, missed_brakes
from study.analysis.metrics import METRICS
from study.document.markdown import markdown
from study.report.build import build_report
from study.report.comparison import compare
from study.report.model import read_report
from tests.support.synthetic_records import HEADS_GRID, World, simulate

GRID = HEADS_GRID.model_copy(update={"heads": ("rec", "full"), "claims": ("H4",)})


@pytest.fixture(scope="module")
def record():
    return simulate(GRID, World(epochs=8))


def test_it_counts_full_throttle_where_the_expert_brakes(record):
    (result, *_) = record.results.values()
    answers, labels = result.predictions["acceleration"], result.predictions["acceleration_label"]
    by_hand = [sum(answer == 2 for answer in row[labels == 0]) / sum(labels == 0) for row in answers]
    np.testing.assert_allclose(missed_brakes(result), by_hand)


def test_a_metric_needs_its_record_alone(record, monkeypatch, tmp_path):
    monkeypatch.setitem(METRICS, MISSED_BRAKES.name, MISSED_BRAKES)
    pdf = build_report(record, tmp_path)
    report = read_report(tmp_path / "heads")
    spread = report.scores[0].metrics["missed_brakes"]
    assert spread.n == 15
    text = " ".join(" ".join(page.extract_text().split()) for page in PdfReader(pdf).pages)
    assert "missed brakes [%]" in text
    assert f"{100 * spread.mean:.1f} ({100 * spread.sd:.1f})" in text
    assert MISSED_BRAKES.about in text.replace("\N{RIGHT SINGLE QUOTATION MARK}", "'")
    assert json.loads((tmp_path / "heads/report.json").read_text())["metrics"][-1]["title"] == "missed brakes"
    monkeypatch.delitem(METRICS, MISSED_BRAKES.name)  # a comparison needs the reports alone
    assert f"| rec | {100 * spread.mean:.1f} (15) |" in markdown(compare(report, report, ("a", "b")))
