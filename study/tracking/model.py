"""A cell's network as an MLflow model: what goes in, what comes out, an example, and what it needs to run."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from mlflow.entities import LoggedModelOutput
from mlflow.models import Model, ModelSignature
from mlflow.tracking import MlflowClient
from mlflow.types import Schema, TensorSpec

from study.atomic import scratch_folder
from study.config.paper import ACCELERATIONS, IMAGE
from study.results.cell_result import CellResult

MODEL = "driver"  # so that runs:/<run id>/driver is a cell's model
TYPE = "encoder with policies"
DATA, NETWORK = "data", "model.pt2"  # where mlflow.pytorch looks
EXAMPLE = "input_example.json"
DIGITS = 4  # of an example's numbers: two neighbouring colours are 0.0039 apart


def write_model(folder: Path, result: CellResult, network: bytes, run_id: str = "", model_id: str = "") -> None:
    """Write the folder that mlflow.pytorch.load_model reads; `network` comes from study.driving.driver.

    The `pytorch` flavour is not written by mlflow.pytorch, which would load torch and export the network once more.
    There is no `python_function` flavour: MLflow's has room for one output, and this network has two.
    """
    (folder / DATA).mkdir(parents=True)
    (folder / DATA / NETWORK).write_bytes(network)
    example = np.round(result.samples["input"][:1].transpose(0, 3, 1, 2) / 255, DIGITS)
    (folder / EXAMPLE).write_text(json.dumps(example.tolist(), separators=(",", ":")), encoding="utf-8")
    version = str(result.facts.get("provenance", {}).get("packages", {}).get("torch", ""))
    (folder / "requirements.txt").write_text(f"torch=={version.partition('+')[0]}\n" if version else "torch\n")
    seeds = len(result.policies["steering_2_bias"])
    number = np.dtype(np.float32)
    inputs = Schema([TensorSpec(number, (-1, 3, IMAGE, IMAGE))])
    outputs = Schema([TensorSpec(number, (seeds, -1), "steering"), TensorSpec(number, (seeds, -1, 3), "acceleration")])
    model = Model(
        artifact_path=MODEL,
        run_id=run_id or None,
        model_id=model_id or None,
        signature=ModelSignature(inputs, outputs),
        saved_input_example_info={"artifact_path": EXAMPLE, "type": "ndarray", "format": "tf-serving"},
        metadata={
            "cell": result.cell.label,
            "images": "bird views, red, green and blue in [0, 1]",
            "steering": "one number for each policy and image",
            "acceleration": f"logits of {', '.join(map(str, ACCELERATIONS))} for each policy and image",
        },
    )
    model.add_flavor("pytorch", model_data=DATA, pytorch_version=version, code=None)
    model.save(str(folder / "MLmodel"))


def log_model(client: MlflowClient, experiment: str, run_id: str, result: CellResult, network: bytes) -> str:
    """Log the model of a cell run, or resume a logging that was cut off. Returns the model's id."""
    models = client.search_logged_models([experiment], f"source_run_id = '{run_id}'")
    if models:
        model_id = str(models[0].model_id)
    else:
        cell = result.cell.model_dump(mode="json") | {"policy_seeds": len(result.policies["steering_2_bias"])}
        params = {name: str(value) for name, value in cell.items()}
        model_id = str(client.create_logged_model(experiment, MODEL, run_id, {}, params, TYPE).model_id)
    with scratch_folder() as name:
        folder = Path(name) / MODEL
        write_model(folder, result, network, run_id, model_id)
        client.log_model_artifacts(model_id, str(folder))
    client.finalize_logged_model(model_id, "READY")
    outputs = client.get_run(run_id).outputs
    if not outputs or not outputs.model_outputs:
        client.log_outputs(run_id, [LoggedModelOutput(model_id, 0)])
    return model_id
