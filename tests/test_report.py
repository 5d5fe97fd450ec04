import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import pandas as pd
import pytest
from pypdf import PdfReader

from study.config.files import load_profile
from study.config.grid import Grid, Rules
from study.document.blocks import Paragraph, Table
from study.document.markdown import markdown
from study.errors import BadInputError
from study.figures.fonts import Fonts, fonts_for
from study.report import __main__, build
from study.report.build import build_report
from study.report.model import read_report
from study.report.scale import training_scale
from study.report.summary import summarise
from study.report.text import document
from tests.support.synthetic_drives import Wheel, with_drives
from tests.support.synthetic_records import DATASIZE_GRID, HEADS_GRID, World, simulate

SMALL = Grid(name="small", title="T", heads=("rec", "full"), policy_seeds=3, baselines=())


@cache
def pages(pdf):
    """Return the words of each page, with single blanks. No test writes a PDF again."""
    return [" ".join(page.extract_text().split()) for page in PdfReader(pdf).pages]


def pdf_text(pdf):
    return " ".join(pages(pdf))


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    folder = tmp_path_factory.mktemp("reports")
    record = simulate(HEADS_GRID)
    return record, folder, build_report(record, folder)


def test_a_report_is_a_pdf_with_its_numbers_figures_and_table_beside_it(built):
    record, folder, pdf = built
    assert pdf == folder / "heads.pdf"
    assert pdf.read_bytes().startswith(b"%PDF-")
    own = folder / "heads"
    assert {path.name for path in own.iterdir()} == {"report.json", "curves.parquet", "figures"}
    pd.testing.assert_frame_equal(pd.read_parquet(own / "curves.parquet"), record.table(baselines=True))
    assert {path.suffix for path in (own / "figures").iterdir()} == {".svg", ".png"}


def test_the_same_record_gives_the_same_bytes(built, tmp_path):
    record, folder, pdf = built
    again = build_report(record, tmp_path)
    assert again.read_bytes() == pdf.read_bytes()
    assert (tmp_path / "heads" / "report.json").read_bytes() == (folder / "heads" / "report.json").read_bytes()


def test_the_pdf_has_title_bookmarks_and_words_for_its_figures(built):
    reader = PdfReader(built[2])
    assert reader.metadata.title == "Effect of different heads (heads, laptop)"
    assert reader.metadata.creation_date is None
    titles = [entry.title for entry in reader.outline if not isinstance(entry, list)]
    assert [title.split(" ", 1)[-1] for title in titles][:4] == [
        "Summary",
        "Results",
        "Confounds",
        "Claims, one by one",
    ]
    words = [element["/Alt"] for element in elements(reader.trailer["/Root"]["/StructTreeRoot"]) if "/Alt" in element]
    assert any("full ends at" in text for text in words)


def elements(node):
    """Yield a tagged PDF's structure elements below a node."""
    kids = node.get("/K", [])
    for kid in kids if isinstance(kids, list) else [kids]:
        element = kid.get_object() if hasattr(kid, "get_object") else kid
        if hasattr(element, "get"):
            yield element
            yield from elements(element)


def test_json_holds_every_claim_and_score_and_no_word_for_infinity(built):
    text = (built[1] / "heads" / "report.json").read_text()
    content = json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))
    assert [claim["claim"] for claim in content["claims"]] == ["H0", "H1", "H2", "H3", "H4", "H5"]
    assert [score["heads"] for score in content["scores"]] == ["rec", "rec+pred", "rec+plan", "full"]
    assert {score["n"] for score in content["scores"]} == {15}
    for claim in content["claims"]:
        for finding in claim["findings"]:
            assert finding["estimate"]["n"] > 0
            assert finding["estimate"]["kind"]


def test_numbers_in_the_pdf_are_those_of_the_json(built):
    content = json.loads((built[1] / "heads" / "report.json").read_text())
    text = pdf_text(built[2])
    for score in content["scores"]:
        accuracy = score["metrics"]["acceleration_accuracy"]
        row = f"{100 * accuracy['mean']:.2f} +{100 * accuracy['sd']:.2f}"
        assert re.search(row, text)
    assert f"{100 * content['floor']['acceleration_accuracy']:.1f} %" in text
    for claim in content["claims"]:
        assert claim["outcome"] in text


@pytest.fixture(scope="module")
def datasize(tmp_path_factory):
    """Return a report of every fraction at the laptop's settings: the content of its file, and its PDF."""
    folder = tmp_path_factory.mktemp("datasize")
    pdf = build_report(simulate(DATASIZE_GRID, World(epochs=8), settings=load_profile("laptop")), folder)
    return json.loads((folder / "datasize/report.json").read_text()), pdf


def test_the_first_page_says_how_far_the_scale_is_from_the_papers(datasize):
    """Frames, images shown and steps, as shares of 400,000, 80 million and 39,200 at all the data."""
    settings = load_profile("laptop")
    content, pdf = datasize
    (first, *_), scale = pages(pdf), content["scale"]
    assert [row["fraction"] for row in scale] == [1.0, 0.5, 0.25, 0.125, 0.0625]
    assert (scale[0]["frames"], scale[0]["images"], scale[0]["steps"]) == (20_000, 240_000, 157 * 12)
    assert (scale[0]["paper_frames"], scale[0]["paper_images"], scale[0]["paper_steps"]) == (
        400_000,
        80_000_000,
        39_200,
    )
    assert (scale[-1]["frames"], scale[-1]["steps"], scale[-1]["paper_steps"]) == (1250, 120, 2600)
    for words in ("Scale at 100 % of the data", "5.0 % of the paper", "4.8 % of 39", "Scale at 6.25 % of the data"):
        assert words in first
    same = settings.model_copy(update={"encoder": settings.encoder.model_copy(update={"budget": "steps"})})
    steps = {row.steps for row in training_scale(simulate(DATASIZE_GRID, World(epochs=8), settings=same))}
    assert steps == {157 * 12}


def test_a_complete_report_has_no_banner_and_names_its_simulator_and_design(built):
    text = pdf_text(built[2])
    assert "Incomplete" not in text
    assert "highway-env" in text.split("Summary")[0]
    assert "nothing about other encoders" in text


def test_a_report_names_the_machines_of_its_cells_where_they_are_not_the_clients():
    record = simulate(SMALL, World(epochs=6))
    assert "Cells computed on" not in markdown(document(summarise(record)))
    origin = {
        "cpu": "Processor 9",
        "cores": 16,
        "platform": "Linux 6",
        "python": "3.12.3",
        "packages": {"torch": "2.11"},
    }
    there = {"provenance": {**origin, "time": "2026-05-01T00:00:00+00:00"}, "device": "GPU 7"}
    results = {key: replace(result, facts={**result.facts, **there}) for key, result in record.results.items()}
    text = markdown(document(summarise(replace(record, results=results))))
    assert "| Cells computed on | Processor 9, 16 cores, GPU 7; Linux 6; Python 3.12.3, torch 2.11 |" in text


@pytest.fixture(scope="module")
def incomplete(built, tmp_path_factory):
    """Write a report of less into a copy of the folder: cells are missing, and the drives were imported."""
    folder = shutil.copytree(built[1], tmp_path_factory.mktemp("less") / "reports")
    record = simulate(HEADS_GRID, World(epochs=12), unfinished=("rec+plan 100% e0",), failed=("full 100% e0",))
    build_report(replace(record, data=record.data | {"writers": ["lab logger 3"]}), folder)
    return folder


def test_a_report_on_imported_drives_names_their_writer_and_not_our_town(incomplete):
    text = pdf_text(incomplete / "heads.pdf")
    assert "imported drives, written by lab logger 3" in text
    assert "a town of our own" not in text
    assert "frames.balance" in text
    assert "heads-balance-steering --profile laptop --data DIR" in text
    assert "heads-brake-hold-0" not in text, "their writer has no such setting"
    assert not re.search(r"(town|recording|driving)\.[a-z_]+ ", text), "settings that imported drives do not have"
    assert "make heads" not in text, "it would make another report"


@pytest.mark.parametrize(("date", "younger"), [("2026-04-30", False), ("2026-05-02", True)])
def test_a_report_says_when_its_rules_are_younger_than_its_cells(date, younger):
    rules = Rules.model_validate({"fixed": {"date": date, "commit": "ab" * 20}})
    record = simulate(SMALL.model_copy(update={"rules": rules}), World(epochs=6))  # of cells begun on 2026-05-01
    text = markdown(document(summarise(record)))
    assert f"Rules of {date}, commit `ababababab`; cells computed on 2026-05-01" in text
    assert ("The rules were changed after cells of this sweep were computed" in text) == younger


def test_a_report_says_when_nothing_is_known_of_its_rules_or_cells():
    record = simulate(SMALL, World(epochs=6))
    assert "When the rules were fixed is not recorded" in markdown(document(summarise(record)))
    rules = Rules.model_validate({"fixed": {"date": "2026-05-02", "commit": "ab" * 20}})
    old = {key: replace(result, facts={**result.facts, "provenance": {}}) for key, result in record.results.items()}
    record = replace(record, grid=SMALL.model_copy(update={"rules": rules}), results=old)
    assert "results do not say when computed: whether the rules are older is unknown" in markdown(
        document(summarise(record))
    )


def test_unfinished_and_failed_cells_are_named_on_the_first_page(incomplete):
    first = pages(incomplete / "heads.pdf")[0]
    planned = len(HEADS_GRID.cells())
    assert f"Incomplete: {planned - 2} of {planned} cells are finished" in first
    assert "Not finished: rec+plan 100% e0" in first
    assert re.search(r"Failed: full 100% e0 .*loss is nan", first)


def test_a_report_of_less_removes_figures_of_more(built, incomplete):
    assert (built[1] / "heads/figures/multi_results.svg").exists()
    assert not (incomplete / "heads/figures/multi_results.svg").exists()


def test_a_sweep_without_any_result_still_gives_a_report(tmp_path):
    record = simulate(HEADS_GRID, World(epochs=6), unfinished=[cell.label for cell in HEADS_GRID.cells()])
    text = pdf_text(build_report(record, tmp_path))
    assert f"0 of {len(HEADS_GRID.cells())} cells" in text
    assert "No cell is finished" in text


def test_a_title_in_any_script_is_set_in_a_font_that_has_it_or_the_missing_characters_are_named(tmp_path, capsys):
    """DejaVu Sans has Georgian and Arabic; nobody has a character of the private planes."""
    record = simulate(Grid(name="letters", title="ქართული العربية Ω", heads=("full",), policy_seeds=2), World(epochs=6))
    assert "ქართული" in pdf_text(build_report(record, tmp_path))
    assert capsys.readouterr().err == ""
    odd = Grid(name="odd", title="script \U00016b50", heads=("full",), policy_seeds=2)
    fonts = fonts_for(odd.title)
    pdf = build_report(simulate(odd, World(epochs=6)), tmp_path)
    if fonts.missing:
        assert "U+16B50" in capsys.readouterr().err
        assert "Characters are missing: no font on this machine has U+16B50" in pages(pdf)[0]
        assert "U+16B50" in read_report(tmp_path / "odd").characters


def test_words_that_need_no_other_font_get_none():
    assert fonts_for("Größe ≤ x → é … 90 %") == Fonts()


@pytest.mark.parametrize(
    "grid",
    [
        Grid(name="small", title="Two cells, one seed", heads=("rec", "full"), policy_seeds=1),
        Grid(name="only", title="No reference", heads=("full",), fractions=(0.5,), policy_seeds=2),
        Grid(name="encoders", title="Design B", heads=("rec", "full"), encoder_seeds=3, policy_seeds=2),
    ],
    ids=lambda grid: grid.name,
)
def test_other_grids_give_reports_too(grid, tmp_path):
    pdf = build_report(simulate(grid, World(epochs=6)), tmp_path)
    content = json.loads((tmp_path / grid.name / "report.json").read_text())
    assert content["sweep"]["design"] == ("B" if grid.encoder_seeds > 1 else "A")
    assert pdf.stat().st_size > 10_000


def test_no_table_of_a_report_without_baselines_is_set_as_words():
    blocks = document(summarise(simulate(SMALL)))
    assert not [block.text for block in blocks if isinstance(block, Paragraph) and "| --" in block.text]
    assert any(isinstance(block, Table) and block.caption.startswith("Final scores") for block in blocks)


def test_the_datasize_report_has_its_claims(datasize):
    content = datasize[0]
    assert [claim["claim"] for claim in content["claims"]] == ["D1", "D2", "D3", "D4"]
    assert content["figures"][0] == "datasize_convergespeed"


@pytest.fixture(scope="module")
def tracker(empty_store, tmp_path_factory):
    from study.tracking.tracker import Tracker

    return Tracker(f"sqlite:///{shutil.copy(empty_store, tmp_path_factory.mktemp('tracking'))}")


@pytest.fixture(scope="module")
def committed(tracker):
    """Return a record, and the sweep run that holds it."""
    record = simulate(Grid(name="pair", title="T", heads=("rec", "full"), policy_seeds=3), World(epochs=6))
    run = tracker.open_sweep(
        record.grid, record.profile, record.settings, record.planned, record.data, record.provenance
    )
    for key, result in record.results.items():
        cell_run = tracker.start_cell(run, record.planned[key], key, record.settings, record.grid.policy_seeds)
        tracker.commit(cell_run, result)
    tracker.close_sweep(run, "FINISHED")
    return record, run


def test_publish_builds_from_the_tracker_alone_and_logs_what_it_made(tracker, committed, tmp_path):
    record, run = committed
    pdf, code = build.publish(tracker, "pair", None, tmp_path)
    assert code == 0
    assert pdf.read_bytes().startswith(b"%PDF-")
    numbers = json.loads((tmp_path / "pair/report.json").read_bytes())
    assert numbers | {"figures": []} == json.loads(summarise(record).json())
    logged = {item.path for folder in ("report", "figures") for item in tracker.client.list_artifacts(run, folder)}
    assert {"report/pair.pdf", "report/report.json", "figures/test_compare_heads.svg"} <= logged


def test_a_sweep_that_varies_one_setting_is_found_and_takes_nobodys_place(tracker, committed, capsys):
    from study.tracking.variants import with_variants

    record = committed[0]
    settings = record.settings.model_copy(
        update={"frames": record.settings.frames.model_copy(update={"split": "frame"})}
    )
    other = simulate(record.grid.model_copy(update={"name": "pair-split"}), World(epochs=6), seed=1, settings=settings)
    planned = {f"v{key[1:]}": cell for key, cell in other.planned.items()}
    run = tracker.open_sweep(other.grid, other.profile, settings, planned, other.data, other.provenance)
    for key, result in other.results.items():
        new = f"v{key[1:]}"
        tracker.commit(tracker.start_cell(run, planned[new], new, settings, 3), replace(result, key=new))
    tracker.close_sweep(run, "FINISHED")
    imported = {"writers": ["lab logger 3"], "sources": {"encoder": [{"name": "a", "digest": "d"}]}}
    for data, found in (({}, {"frames.split": "pair-split"}), (imported, {})):  # nothing is like another lab's drives
        variants = with_variants(tracker.reader, replace(record, data=record.data | data)).variants
        assert {name: one.grid.name for name, one in variants.items()} == found
    back = with_variants(tracker.reader, tracker.reader.read_sweep("pair-split")).variants
    assert {name: one.grid.name for name, one in back.items()} == {"frames.split": "pair"}
    assert tracker.reader.read_sweep("pair").settings == record.settings
    assert __main__.main(["pair", "--format", "md", "--tracking", tracker.experiment.uri]) == 0
    assert "`frames.split`: episode here, frame in `pair-split`" in capsys.readouterr().out


def test_compare_takes_files_folders_and_sweeps_in_mlflow(tracker, committed, tmp_path, capsys):
    (tmp_path / "report.json").write_bytes(summarise(committed[0]).json())
    for other in (tmp_path / "report.json", f"pair@{tracker.experiment.uri}", f"pair:laptop@{tracker.experiment.uri}"):
        assert __main__.main(["compare", str(tmp_path), str(other)]) == 0
        assert "rec (the same result), full (the same result)" in capsys.readouterr().out
    with pytest.raises(BadInputError, match=r"no sweep 'pair \(paper\)'"):
        __main__.main(["compare", str(tmp_path), "pair:paper", "--tracking", tracker.experiment.uri])
    with pytest.raises(BadInputError, match=r"cannot read nowhere/report\.json"):
        __main__.main(["compare", str(tmp_path), "nowhere/report.json"])
    with pytest.raises(BadInputError, match="Missing argument 'B'"):
        __main__.main(["compare", str(tmp_path)])


def test_compare_draws_into_the_file_that_it_is_given(committed, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "report.json").write_bytes(summarise(committed[0]).json())
    (tmp_path / "my pictures").mkdir()
    for file, picture in (
        (Path("my pictures/a.svg"), "![Dot plot"),
        (tmp_path / "my pictures" / "b.pdf", "\n[Dot plot"),
    ):
        assert __main__.main(["compare", ".", ".", "--figure", str(file)]) == 0
        text = capsys.readouterr().out
        assert picture in text
        assert f"](my%20pictures/{file.name})" in text
    assert {path.name for path in Path("my pictures").iterdir()} == {"a.svg", "b.pdf"}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["compare", "a", "b", "--profile", "smoke"], "No such option '--profile'"),
        (["compare", "a", "b", "--out", "there"], "No such option '--out'"),
        (["compare", "a", "b", "--figure", "x.jpg"], r"--figure x\.jpg: write \.svg, \.png, \.pdf"),
        (["compare", "a", "b", "--figure", "x"], r"--figure x: write"),
        (["compare", "a", "b", "--figure", "nowhere/x.svg"], "no folder nowhere; make it first"),
        (["compare", "a", "b", "--figure", "folder.png"], "is a folder"),
        (["heads", "--figure", "x.png"], "No such option '--figure'"),
    ],
)
def test_a_figure_that_cannot_be_is_refused_before_anything_is_read(words, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(BadInputError, match=message):
        __main__.main(words)
    assert [path.name for path in tmp_path.iterdir()] == ["folder.png"]


def test_format_md_prints_tables_and_writes_nothing(tracker, committed, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert __main__.main(["pair", "--format", "md", "--tracking", tracker.experiment.uri]) == 0
    assert "| full | 3 |" in capsys.readouterr().out
    assert list(tmp_path.iterdir()) == []


def test_a_folder_for_what_is_printed_is_refused(tracker, committed, tmp_path):
    words = ["pair", "--format", "md", "--out", str(tmp_path), "--tracking", tracker.experiment.uri]
    with pytest.raises(BadInputError, match="goes with --format pdf; md is printed"):
        __main__.main(words)


def test_a_sweep_that_was_never_run_is_bad_input(tracker, tmp_path):
    with pytest.raises(BadInputError, match="no sweep 'heads'"):
        build.publish(tracker, "heads", None, tmp_path)


def test_the_command_says_what_is_wrong_and_exits_with_2(tracker):
    command = [sys.executable, "-m", "study.report", "nosuch", "--tracking", tracker.experiment.uri]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert "no sweep 'nosuch'" in done.stderr
    assert "Traceback" not in done.stderr


def test_help_needs_no_heavy_library():
    code = (
        "import sys; from study.report import __main__ as report; report.main(['--help']); "
        "print(sorted({'mlflow', 'matplotlib', 'scipy', 'typst', 'torch'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


# --- at the wheel ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def driven(tmp_path_factory):
    """Return the record of a sweep whose policies have driven, and the folder of its report."""
    ours = HEADS_GRID.model_copy(update={"claims": (*HEADS_GRID.claims, "C1", "C2", "C3")})
    record, folder = with_drives(simulate(ours, World(epochs=6))), tmp_path_factory.mktemp("driven")
    build_report(record, folder)
    return record, folder


def test_a_report_of_policies_that_have_driven_says_how(driven):
    record, folder = driven
    report = read_report(folder / "heads")
    assert [place.place for place in report.driving.places] == ["town", "unseen"]
    assert [row.heads for row in report.driving.town.cells] == ["rec", "rec+pred", "rec+plan", "full"]
    assert {row.drives for row in report.driving.town.rows} == {20}
    assert {"driving_score", "driving_ends", "accuracy_driving", "driving_differences"} <= set(report.figures)
    pd.testing.assert_frame_equal(pd.read_parquet(folder / "heads/drives.parquet"), record.drive_table)
    text = pdf_text(folder / "heads.pdf")
    assert "At the wheel, driving score (0 to 100) on 20 held-out drives" in pages(folder / "heads.pdf")[0]
    for row in report.driving.town.rows:
        assert f"{row.cell} {row.metrics['driving_score'].mean:.1f}" in text
    assert "C1 (ours, not the paper" in text
    assert "Its n is the 20 drives" in text


def test_a_report_without_drives_has_no_page_and_no_table_of_them(driven, tmp_path):
    record = driven[0]
    folder = shutil.copytree(driven[1], tmp_path / "reports")
    build_report(replace(record, drives={}), folder)
    assert not (folder / "heads/drives.parquet").exists()
    assert read_report(folder / "heads").driving is None
    text = pdf_text(folder / "heads.pdf")
    assert "At the wheel" not in text
    assert "Its policies have not driven (--drive true;" in text


@pytest.mark.parametrize(
    "wheel", [Wheel(drives=1, unseen=0), Wheel(drives=2, unseen=1, policies=1)], ids=["one drive", "few drives"]
)
def test_few_drives_give_a_report_too(wheel):
    record = with_drives(simulate(SMALL, World(epochs=6)), wheel)
    text = markdown(document(summarise(record)))
    assert "## At the wheel" in text.replace("### ", "## ")
    assert not re.search(r"\bnan\b", text)


def test_cells_that_have_not_driven_are_left_out_of_the_tables():
    record = with_drives(simulate(SMALL, World(epochs=6)), without=("rec",))
    report = summarise(record)
    assert [row.heads for row in report.driving.town.cells] == ["full"]
    assert report.driving.contrasts == ()
