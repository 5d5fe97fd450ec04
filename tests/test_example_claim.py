"""A claim, added by one record, has its verdict in the PDF."""

from pypdf import PdfReader

from examples.claim import PLAN_IS_FAST
from study.analysis.claims import CLAIMS
from study.report.build import build_report
from study.report.model import read_report
from tests.support.synthetic_records import HEADS_GRID, World, simulate


def test_a_claim_needs_its_record_alone(monkeypatch, tmp_path):
    monkeypatch.setitem(CLAIMS, PLAN_IS_FAST.name, PLAN_IS_FAST)
    pdf = build_report(simulate(HEADS_GRID.model_copy(update={"claims": ()}), World(epochs=40)), tmp_path)
    verdict = read_report(tmp_path / "heads").claims[-1]
    assert (verdict.claim, verdict.outcome) == ("X1", "reproduced")
    assert [finding.what for finding in verdict.findings] == [
        "rec+plan reaches rec's final",
        "full reaches rec's final",
    ]
    first, *pages = (" ".join(page.extract_text().split()) for page in PdfReader(pdf).pages)
    assert f"X1 {PLAN_IS_FAST.text[:30]}" in first.replace("\N{RIGHT SINGLE QUOTATION MARK}", "'")
    assert any("X1 (Sec. none, ours)" in page for page in pages)
