"""What a person sees of a sweep in MLflow's own pages, on a real server.

The requests that the pages make are checked everywhere, the pages themselves where the system has a Chromium.
"""

import http.client
import json
import os
import re
import shutil
import subprocess
import sys
import urllib.parse
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect, sync_playwright

from study.data.card import card_files
from study.data.frames import open_frames
from study.driving.driver import export_driver
from study.tracking.tracker import Tracker
from tests.support.processes import ROOT
from tests.support.servers import LOOPBACK, TrackingServer
from tests.support.synthetic_records import HEADS_GRID, World, simulate

pytestmark = pytest.mark.stress

ACCURACY, STEERING = "policy/test/acceleration_accuracy", "policy/test/steering_loss"
COLUMNS = ("heads", "fraction", "encoder_seed", "policy_seeds", "state", "final/acceleration_accuracy")
LABELS = ("full 100% e0", "rec 100% e0", "rec+plan 100% e0", "rec+pred 100% e0")
EPOCHS, SEEDS = 8, 2
REFERENCE = ROOT / "reports/reference/heads"


@pytest.fixture(scope="module")
def server(empty_store, tmp_path_factory):
    running = TrackingServer(Path(shutil.copy(empty_store, tmp_path_factory.mktemp("ui"))).parent)
    yield running
    running.stop()


@pytest.fixture(scope="module")
def sweep(server, small_store, small_drives):
    """Log a finished sweep of the four head sets: drawn curves, a real report, the card of real frames, models."""
    record = simulate(HEADS_GRID.model_copy(update={"policy_seeds": SEEDS, "baselines": ()}), World(epochs=EPOCHS))
    tracker = Tracker(server.uri)
    run_id = tracker.open_sweep(
        record.grid, record.profile, record.settings, record.planned, record.data, record.provenance
    )
    tracker.log_files(run_id, card_files(open_frames(small_store), small_drives, small_store), "data")
    tracker.log_files(run_id, [REFERENCE / "report.pdf"], "report")
    tracker.log_files(run_id, [REFERENCE / "test_compare_heads.png"], "figures")
    network = export_driver(next(iter(record.results.values())))  # drawn weights are all the same
    for key, cell in record.planned.items():
        run = tracker.start_cell(run_id, cell, key, record.settings, SEEDS)
        tracker.commit(run, record.results[key], network)
    tracker.close_sweep(run_id, "FINISHED")
    return run_id


def ask(server, path, **body):
    """Send a page's own request, a POST where it has a body."""
    connection = http.client.HTTPConnection(LOOPBACK, server.port, timeout=120)
    words = ("POST", json.dumps(body), {"Content-Type": "application/json"}) if body else ("GET", None, {})
    connection.request(words[0], f"/{path}", *words[1:])
    answer = connection.getresponse()
    content = answer.read()
    assert answer.status == 200, content
    return content


def api(server, path, **body):
    return json.loads(ask(server, f"ajax-api/2.0/mlflow/{path}", **body))


@pytest.fixture(scope="module")
def experiment(server, sweep):
    response = api(server, "experiments/search", max_results=10, order_by=["last_update_time DESC"])["experiments"]
    (study,) = [each for each in response if each["name"] == "study"]
    return study["experiment_id"], {tag["key"]: tag["value"] for tag in study["tags"]}


@pytest.fixture(scope="module")
def address(server, experiment):
    """Return the address behind the link in the experiment's description."""
    link = re.search(r"\[All cells with their scores\]\((.+?)\)", experiment[1]["mlflow.note.content"]).group(1)
    return f"{server.uri}/{link}"


def runs(server, experiment, query):
    response = api(server, "runs/search", experiment_ids=[experiment[0]], filter=query, max_results=100)["runs"]
    return {run["info"]["run_name"]: run for run in response}


@pytest.fixture(scope="module")
def cells(server, experiment):
    view = json.loads(experiment[1]["mlflow.sharedViewState.cells"])
    return runs(server, experiment, view["searchFilter"])


# --- by the pages' requests -----------------------------------------------------------------------------------------


def test_the_view_lists_the_cells_with_all_that_its_columns_name(cells, experiment):
    assert tuple(sorted(cells)) == LABELS
    wanted = json.loads(experiment[1]["mlflow.sharedViewState.cells"])["selectedColumns"]
    assert [re.search("`(.+)`", column).group(1) for column in wanted][:6] == list(COLUMNS)
    for name, run in cells.items():
        columns = {
            f"{kind}.`{item['key']}`": item["value"]
            for kind in ("params", "metrics", "tags")
            for item in run["data"][kind]
        }
        assert set(wanted) <= set(columns)
        assert columns["params.`heads`"] == name.split()[0]
        assert columns["tags.`state`"] == "finished"
        assert len(str(columns["metrics.`final/acceleration_accuracy`"])) <= len("0.12345")
        assert "mlflow.note.content" in {tag["key"] for tag in run["data"]["tags"]}


def test_nothing_is_running_when_the_sweep_has_ended(server, experiment):
    assert {run["info"]["status"] for run in runs(server, experiment, "").values()} == {"FINISHED"}


@pytest.mark.parametrize("metric", [ACCURACY, STEERING])
def test_a_comparison_of_the_cells_gets_a_complete_mean_curve_of_each(server, cells, metric):
    names = [("run_ids", run["info"]["run_id"]) for run in cells.values()]
    words = urllib.parse.urlencode([*names, ("metric_key", metric), ("max_results", 320)])
    points = api(server, f"metrics/get-history-bulk-interval?{words}")["metrics"]
    for _, run_id in names:
        assert [point["step"] for point in points if point["run_id"] == run_id] == list(range(1, EPOCHS + 1))


def test_report_figures_card_and_manifest_are_served(server, sweep):
    def files(path):
        response = api(server, f"artifacts/list?run_id={sweep}&path={path}").get("files", [])
        return {Path(file["path"]).name for file in response}

    assert {"report", "figures", "data", "data.json", "plan.json"} <= files("")
    assert files("data") == {"card.json", "card.txt", "card.png"}
    starts = {"report/report.pdf": b"%PDF", "figures/test_compare_heads.png": b"\x89PNG", "data/card.png": b"\x89PNG"}
    for path, start in starts.items():
        assert ask(server, f"get-artifact?path={path}&run_uuid={sweep}").startswith(start)
    assert "sets" in json.loads(ask(server, f"get-artifact?path=data.json&run_uuid={sweep}"))


def test_each_cell_has_its_model(server, experiment, cells):
    response = api(server, "logged-models/search", experiment_ids=[experiment[0]])["models"]
    sources = {model["info"]["source_run_id"] for model in response}
    assert sources == {run["info"]["run_id"] for run in cells.values()}
    assert {model["info"]["status"] for model in response} == {"LOGGED_MODEL_READY"}


LOAD = """
import sys, mlflow, torch
answer = mlflow.pytorch.load_model(sys.argv[1])(torch.zeros(5, 3, 64, 64))
print(tuple(answer["steering"].shape), bool(answer["steering"].any()), tuple(answer["acceleration"].shape))
"""


def test_a_model_comes_back_from_the_server(server, cells):
    """As a user loads it: in a process of its own, with MLflow's variables."""
    variables = {"MLFLOW_ALLOW_PICKLE_DESERIALIZATION": "false", "MLFLOW_TRACKING_URI": server.uri}
    command = [sys.executable, "-c", LOAD, f"runs:/{cells['full 100% e0']['info']['run_id']}/driver"]
    loaded = subprocess.run(command, env=os.environ | variables, capture_output=True, text=True, check=False)
    # The drawn policies answer zero.
    assert loaded.stdout.splitlines()[-1:] == [f"({SEEDS}, 5) False ({SEEDS}, 5, 3)"], loaded.stderr


# --- by the pages themselves ----------------------------------------------------------------------------------------

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
PATIENCE = 180_000.0  # [ms] for a page to show what it should; a busy machine is slow


@pytest.fixture(scope="module")
def page():
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        pytest.skip("no Chromium on this machine; the requests of the pages are checked all the same")
    expect.set_options(timeout=PATIENCE)
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, chromium_sandbox=False, timeout=PATIENCE)
        page = browser.new_page(viewport={"width": 2600, "height": 1000})
        page.set_default_timeout(PATIENCE)
        yield page
        browser.close()


def open_page(page: Page, address):
    """Load an address anew: MLflow's pages differ only in what follows the #, which a browser takes for the same."""
    page.goto("about:blank")
    page.goto(address)


# Charts whose lines end at as many different values as there are cells; MLflow draws each line twice.
DRAWN = """({points, lines, charts}) => [...document.querySelectorAll('.js-plotly-plot')]
    .filter(plot => plot.data && new Set(plot.data.filter(line => line.y && line.y.length == points)
    .map(line => line.y[line.y.length - 1])).size == lines).length == charts"""


def test_the_list_of_cells_shows_their_states_and_scores(page, address, cells):
    open_page(page, address)
    body = page.locator("body")
    for label in LABELS:
        expect(body).to_contain_text(label)
    text = body.inner_text()
    for column in COLUMNS:
        assert column in text
    assert text.count("finished") == len(LABELS)
    for run in cells.values():
        (accuracy,) = [m["value"] for m in run["data"]["metrics"] if m["key"] == "final/acceleration_accuracy"]
        assert str(accuracy) in text


def test_the_charts_of_the_cells_are_mean_curves(page, address):
    open_page(page, f"{address}&compareRunsMode=CHART")
    page.wait_for_function(DRAWN, arg={"points": EPOCHS, "lines": len(LABELS), "charts": 2})


def test_the_report_opens_where_it_was_filed(page, server, experiment, sweep):
    artifacts = f"{server.uri}/#/experiments/{experiment[0]}/runs/{sweep}/artifacts"
    open_page(page, f"{artifacts}/report/report.pdf?workflowType=machine_learning")
    page.wait_for_function("[...document.querySelectorAll('canvas')].some(page => page.width > 100)")
    open_page(page, f"{artifacts}/figures/test_compare_heads.png?workflowType=machine_learning")
    page.wait_for_function("[...document.images].some(image => image.complete && image.naturalWidth > 500)")
    assert {"data.json", "plan.json"} <= set(page.locator("body").inner_text().split())


def test_the_models_are_listed(page, server, experiment):
    open_page(page, f"{server.uri}/#/experiments/{experiment[0]}/models?workflowType=machine_learning")
    for label in LABELS:
        expect(page.locator("body")).to_contain_text(label)
    assert "driver" in page.locator("body").inner_text()
