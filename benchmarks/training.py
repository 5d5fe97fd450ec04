"""Training against what one would write first, and against the machine's limits: `python benchmarks/training.py`.

Encoder: `train_encoder` in a worker of the engine, as a sweep calls it (Lightning, checkpoints, progress and losses
reported), against a bare torch loop over tensors in memory with the same networks, precision and optimiser, epoch by
epoch in turn, and against a stock Lightning template with a DataLoader of two workers (`plain.py`). Each computes in
one thread, as the tasks of a sweep do; the template's workers come on top. Policies: all 15 seeds of a cell, trained as
two shares on two workers of an engine that is warm, against 15 plain fits one after the other. An epoch is all of it:
training, evaluating the test split, reporting; of policies also sending the latents and joining the shares. Data are
random: values cost no time.

Printed are medians with the lowest and highest; the floor of a stage is what its multiplications take at the speed of a
large matrix product on one core, or its bytes at the speed of a copy, whichever takes longer. On a processor that
does not multiply bf16 itself everything is in float32, and what is left out is said and null in the result. Slow
processors get fewer frames, and slow or busy ones fewer rounds: all takes less than ten minutes. `--quick` tries
everything on almost no data, and keeps nothing.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import plain
import torch

from study.compute.device import choose_precision
from study.compute.provenance import cores, provenance
from study.config.heads import HEAD_SETS, HEADS
from study.config.paper import CHANNELS, CORE, IMAGE, KERNEL, LATENT
from study.config.settings import EncoderSettings, FramesSettings, PolicySettings
from study.data.frames import Frames, shapes
from study.encoder import training
from study.encoder.autoencoder import MultiHeadAutoencoder
from study.encoder.batches import plan_training
from study.encoder.training import train_encoder
from study.engine.dask_engine import DaskEngine
from study.engine.flows import run_flow
from study.engine.local import local_engine
from study.policy.networks import WIDTHS
from study.policy.training import TrainedPolicies, join_policies, train_policies
from study.stages import ENCODER, POLICY, Batch, Flow, Task

RESULT = Path(__file__).parent / "results" / "training.json"
BATCHES = {"laptop": 128, "paper": 2048}  # of encoders
FRAMES = {"laptop": (1536, 384), "paper": (4096, 1024)}  # train, test
CONFIGURATIONS = (("laptop", "rec"), ("laptop", "full"), ("paper", "full"))
EPOCHS = {"laptop": 5, "paper": 3}  # of ours and of the bare loop; the first is not counted
PLAIN_EPOCHS = {"laptop": 3, "paper": 2}  # of the template; the first is not counted
LATEST = {"encoder": 240.0, "round": 420.0}  # [s] after the start, when another encoder or round still begins
PROBE = 256  # frames on which the processor's speed is tried before
FAST = 300.0  # images/s of `full` in a bare loop on one core, from which on all frames are used
POLICY_FRAMES = {"laptop": (10_000, 2_500), "paper": (64_000, 16_000)}
POLICY_BATCHES = {"laptop": 512, "paper": 2048}
POLICY_EPOCHS = 4  # of a plain fit; the first is not counted
STACKED_EPOCHS = {"laptop": 50, "paper": 10}  # of ours, all counted; a study's are 100
POLICY_ROUNDS = 3  # or fewer, at LATEST
SEEDS = 15
WORKERS = 2  # of the engine; as many shares of the seeds
CPU = torch.device("cpu")
PACKAGES = ("lightning", "numpy", "torch")

Numbers = dict[str, Any]


Report = Callable[..., None]


def spread(values: Iterable[float]) -> Numbers | None:
    """Median, lowest and highest; None of nothing."""
    values = sorted(values)
    if not values:
        return None
    return {"median": float(np.median(values)), "low": values[0], "high": values[-1], "n": len(values)}


# --- the machine's limits -------------------------------------------------------------------------------------------


def fastest(work: Callable[[], Any], times: int = 8) -> float:
    """Seconds of the fastest of some calls."""
    seconds = []
    for _ in range(times):
        begin = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - begin)
    return min(seconds)


def has_bf16() -> bool:
    """Whether this processor multiplies bf16 matrices itself."""
    return choose_precision("auto", CPU) == "bf16"


def peaks(side: int) -> Numbers:
    """Multiplications a second in a square matrix product, and bytes a second in a copy, by one thread."""
    found: Numbers = {"bf16_multiplications_per_s": None}
    for name, kind in (("fp32", torch.float32), ("bf16", torch.bfloat16))[: 1 + has_bf16()]:
        one, other = torch.rand(side, side).to(kind), torch.rand(side, side).to(kind)
        out = torch.empty_like(one)
        found[f"{name}_multiplications_per_s"] = side**3 / fastest(lambda a=one, b=other, c=out: torch.mm(a, b, out=c))
    source = torch.ones(side * side * 16)
    target = torch.empty_like(source)
    found["copy_bytes_per_s"] = 2 * source.nbytes / fastest(lambda: target.copy_(source))
    return found


def encoder_work(heads: str, size: int) -> tuple[int, int]:
    """Multiplications and bytes of an image trained on, in numbers of `size` bytes.

    Forward, and twice that backward but for the gradient of the image. Each layer's output is written and read once
    forward; backward it is read again, and its gradient written and read.
    """
    sides = list(itertools.accumulate(CHANNELS, lambda side, _: (side - KERNEL) // 2 + 1, initial=IMAGE))
    ways = list(itertools.pairwise((HEADS["rec"].channels, *CHANNELS)))
    each = [a * b * KERNEL**2 * side**2 for (a, b), side in zip(ways, sides[1:], strict=True)]
    connected = CHANNELS[-1] * CORE**2 * LATENT
    numbers = sum(after * side**2 for (_, after), side in zip(ways, sides[1:], strict=True))
    multiplications = 3 * (sum(each) + connected) - each[0]
    moved = 5 * numbers * size + IMAGE**2 * 3
    for head in HEAD_SETS[heads].heads:
        multiplications += 3 * (sum(each[1:]) + each[0] * HEADS[head].channels // HEADS["rec"].channels + connected)
        moved += 5 * (numbers * size + HEADS[head].channels * IMAGE**2 * 4) + IMAGE**2 // 8
    return multiplications, moved


def policy_work() -> tuple[int, int]:
    """Multiplications and bytes of a frame that one policy is trained on.

    As above, but what one seed's step works on stays in a core's cache: z, order, labels and dropout bits come in.
    """
    multiplications = 0
    for widths in WIDTHS.values():
        products = [before * after for before, after in itertools.pairwise(widths)]
        multiplications += 3 * sum(products) - products[0]
    bits = sum(sum(widths[1:-1]) for widths in WIDTHS.values()) // 8
    return multiplications, 2 * (LATENT * 4 + 8 + 12 + bits)


def floor(work: tuple[int, int], precision: str, limits: Numbers) -> Numbers:
    """Work of a unit, and units a second at the machine's limits."""
    multiplications, moved = work
    seconds = {
        "multiplications": multiplications / limits[f"{precision}_multiplications_per_s"],
        "bytes": moved / limits["copy_bytes_per_s"],
    }
    bound = max(seconds, key=lambda name: seconds[name])
    return {"multiplications": multiplications, "bytes": moved, "bound": bound, "per_s": 1 / seconds[bound]}


# --- encoder --------------------------------------------------------------------------------------------------------


def random_frames(train: int, test: int, folder: Path | None = None) -> Frames:
    """Frames of any content; mapped from files of zeros when there is a folder."""
    rng = np.random.default_rng(0)
    arrays = {}
    for name, shape in shapes(2).items():
        whole = (train + test, *shape)
        if folder is None:
            arrays[name] = rng.integers(0, 256, whole, np.uint8)
        else:
            np.lib.format.open_memmap(folder / name, mode="w+", dtype=np.uint8, shape=whole)
            arrays[name] = np.load(folder / name, mmap_mode="r")
    labels = pd.DataFrame({"train": np.arange(train + test) < train, "episode": np.arange(train + test) // 100})
    return Frames(arrays["images"], arrays["masks"], labels)


def bare_epochs(frames: Frames, heads: str, settings: EncoderSettings, precision: str) -> Iterator[float]:
    """Seconds of one epoch after the other: a loop over tensors in memory, and nothing else."""
    images, masks = torch.from_numpy(frames.images), torch.from_numpy(frames.masks)
    train, test = (torch.from_numpy(frames.indices(split)) for split in ("train", "test"))
    module = MultiHeadAutoencoder(heads, settings, 0)
    optimizer = module.configure_optimizers()
    while True:
        begin = time.perf_counter()
        total = torch.zeros(2, len(module.metrics))
        with torch.autocast("cpu", torch.bfloat16, enabled=precision == "bf16"):
            module.train()
            for rows in train[torch.randperm(len(train))].split(settings.batch):
                optimizer.zero_grad()
                total[0] += module.gradients(images[rows], masks[rows], None)
                optimizer.step()
            module.eval()
            with torch.inference_mode():
                for rows in test.split(settings.batch):
                    total[1] += module.losses(images[rows], masks[rows])
        total.tolist()
        yield time.perf_counter() - begin


@contextmanager
def timed_checkpoints() -> Iterator[list[float]]:
    """Seconds of each checkpoint that is written meanwhile."""
    seconds: list[float] = []
    write = training.write_checkpoint  # noqa: SLF001 - only here its time can be told from the rest

    def timed(*what: Any) -> None:
        begin = time.perf_counter()
        write(*what)
        seconds.append(time.perf_counter() - begin)

    training.write_checkpoint = timed  # noqa: SLF001
    try:
        yield seconds
    finally:
        training.write_checkpoint = write  # noqa: SLF001


def turn_about(
    heads: str, frames_of: tuple[int, int], settings: EncoderSettings, report: Report
) -> dict[str, list[float]]:
    """Seconds an epoch of ours and of the bare loop, and the seconds of ours that went into reports."""
    torch.set_num_threads(1)
    frames, precision = random_frames(*frames_of), choose_precision("auto", CPU)
    bare = bare_epochs(frames, heads, settings, precision)
    next(bare)  # warms up
    found: dict[str, list[float]] = {"ours": [], "bare": [], "reporting": []}
    begin = reporting = 0.0

    def tell(*values: Any) -> None:
        nonlocal reporting
        start = time.perf_counter()
        report(*values)
        reporting += time.perf_counter() - start

    def log(epoch: int, losses: dict[str, float]) -> None:
        nonlocal begin, reporting
        tell("log", epoch, losses)
        if epoch > 1:
            found["ours"].append(time.perf_counter() - begin)
            found["reporting"].append(reporting)
            found["bare"].append(next(bare))
        reporting, begin = 0.0, time.perf_counter()

    with tempfile.TemporaryDirectory() as folder, timed_checkpoints() as found["checkpoint"]:
        train_encoder(
            frames,
            heads,
            1.0,
            0,
            settings,
            FramesSettings(),
            device="cpu",
            checkpoint=Path(folder) / "checkpoint",
            log=log,
            progress=lambda done, total: tell("progress", done, total),
        )
    return found


def one_batch(*tasks: Task) -> Flow[list[Any]]:
    """Yield one batch of one stage."""
    return (yield Batch(tasks))


def encoder(engine: DaskEngine, heads: str, size: str, limits: Numbers) -> Numbers:
    """One head set at one batch size: ours, the bare loop, the template in fp32 and in bf16."""
    batch, (train, test) = BATCHES[size], FRAMES[size]
    frames = random_frames(train, test)
    precision = choose_precision("auto", CPU)
    settings = EncoderSettings(batch=batch, epochs=EPOCHS[size])
    steps = plan_training(frames, 1.0, 0, settings, FramesSettings()).steps
    templates = {"template": plain.fit_encoder(frames, heads, batch, PLAIN_EPOCHS[size], "32-true")}
    task = Task(ENCODER, turn_about, (heads, (train, test), settings), reports=True)
    (found,) = run_flow(one_batch(task), engine)
    templates["template_bf16"] = (
        plain.fit_encoder(frames, heads, batch, PLAIN_EPOCHS[size], "bf16-mixed") if has_bf16() else []
    )
    rates = {name: [train / seconds for seconds in found[name]] for name in ("ours", "bare")}
    rates |= {name: [train / seconds for seconds in epochs] for name, epochs in templates.items()}
    pairs = [ours / bare for ours, bare in zip(rates["ours"], rates["bare"], strict=True)]
    limit = floor(encoder_work(heads, 2 if precision == "bf16" else 4), precision, limits)
    ours = float(np.median(rates["ours"]))
    reporting = sum(found["reporting"]) / sum(found["ours"])
    return {
        "heads": heads,
        "batch": batch,
        "frames": [train, test],
        "steps": steps,
        "precision": precision,
        "images_per_s": {name: spread(values) for name, values in rates.items()},
        "ratio_to_bare": spread(pairs),
        **{f"ratio_to_{name}": ours / float(np.median(rates[name])) if rates[name] else None for name in templates},
        "reporting_share": reporting + float(np.median(found["checkpoint"])) / training.CHECKPOINT_SECONDS,
        "checkpoint_s": spread(found["checkpoint"]),
        "floor": limit | {"reached": ours / limit["per_s"]},
    }


def use_fewer_frames() -> None:
    """On a slow processor, shorten the epochs: nobody waits for half an hour."""
    frames = random_frames(PROBE, PROBE // 4)
    epochs = bare_epochs(frames, "full", EncoderSettings(batch=BATCHES["laptop"]), choose_precision("auto", CPU))
    next(epochs)
    share = min(1.0, PROBE / next(epochs) / FAST)
    for size, (train, _) in FRAMES.items():
        steps = max(2 if size == "laptop" else 1, round(share * train / BATCHES[size]))
        FRAMES[size] = (steps * BATCHES[size], steps * BATCHES[size] // 4)


def encoders(limits: Numbers, began: float, skipped: list[str]) -> Numbers:
    """All configurations that there is time for, and the worst of each ratio."""
    found = []
    for size, heads in CONFIGURATIONS:
        if found and time.monotonic() - began > LATEST["encoder"]:
            skipped.append(f"encoder {heads} at batch {BATCHES[size]}: no time left, the machine is slow or busy")
            continue
        with scratch_engine(1) as engine:
            found.append(encoder(engine, heads, size, limits))
        print(json.dumps(found[-1]), file=sys.stderr)  # it takes minutes: what is measured should not be lost
    return {
        "images_per_s": found[-1]["images_per_s"]["ours"]["median"],  # of the last, `full`
        "ratio_to_bare": min(each["ratio_to_bare"]["median"] for each in found),
        "ratio_to_template": min(each["ratio_to_template"] for each in found),
        "reporting_share": max(each["reporting_share"] for each in found),
        "configurations": found,
    }


@contextmanager
def scratch_engine(workers: int) -> Iterator[DaskEngine]:
    """Have an engine on this machine."""
    with tempfile.TemporaryDirectory() as folder, local_engine(workers, Path(folder)) as engine:
        yield engine


# --- memory ---------------------------------------------------------------------------------------------------------


def memory(precision: str) -> int:
    """Highest memory of a process of its own that trains `full` at the paper's batch, beside mapped files [bytes]."""
    program = [sys.executable, *sys.argv, "--memory", precision]
    return int(subprocess.run(program, check=True, capture_output=True, text=True).stdout)


def train_for_memory(precision: str) -> None:
    """Train `full` on two batches, look at our own memory every 5 ms, print the highest."""
    page, seen, done = os.sysconf("SC_PAGE_SIZE"), [0], threading.Event()

    def look() -> None:
        while not done.wait(0.005):
            resident, shared = Path("/proc/self/statm").read_text().split()[1:3]  # shared: what is mapped from files
            seen.append((int(resident) - int(shared)) * page)

    watcher = threading.Thread(target=look)
    watcher.start()
    batch = BATCHES["paper"]
    settings = EncoderSettings(batch=batch, epochs=1, lr=5e-3, precision=precision)  # type: ignore[arg-type]
    with tempfile.TemporaryDirectory() as folder:
        frames = random_frames(2 * batch, batch // 2, Path(folder))
        train_encoder(
            frames,
            "full",
            1.0,
            0,
            settings,
            FramesSettings(),
            device="cpu",
            checkpoint=Path(folder) / "checkpoint",
            log=lambda *_: None,
        )
    done.set()
    watcher.join()
    print(max(seen))


# --- policies -------------------------------------------------------------------------------------------------------


def latents(frames: int, seed: int) -> tuple[np.ndarray, pd.DataFrame]:
    """Latents and labels of the right kind."""
    rng = np.random.default_rng(seed)
    z = rng.normal(size=(frames, LATENT)).astype(np.float32)
    return z, pd.DataFrame({"steering": np.tanh(z[:, 0]) / 4, "acceleration": np.digitize(z[:, 1], [-0.5, 0.5])})


def train_share(
    train: plain.Labelled, test: plain.Labelled, seeds: list[int], settings: PolicySettings, report: Report
) -> TrainedPolicies:
    """Train the policies of some seeds, as `study.cell` does."""
    return train_policies(
        train[0],
        test[0],
        train[1],
        test[1],
        seeds,
        settings,
        log=lambda epoch, metrics: report("log", epoch, metrics),
        progress=lambda done, total: report("progress", done, total),
    )


def seconds_of_an_epoch(
    engine: DaskEngine, train: plain.Labelled, test: plain.Labelled, batch: int, epochs: int
) -> float:
    """Of all seeds, in shares: sending, training, measuring, and waiting for the last share included."""
    settings = PolicySettings(epochs=epochs, batch=batch)
    shares = [part.tolist() for part in np.array_split(np.arange(SEEDS), WORKERS)]
    begin = time.perf_counter()
    tasks = [Task(POLICY, train_share, (train, test, seeds, settings), len(seeds), reports=True) for seeds in shares]
    join_policies(run_flow(one_batch(*tasks), engine))
    return (time.perf_counter() - begin) / epochs


def policies(engine: DaskEngine, size: str, limits: Numbers, began: float) -> Numbers:
    """Seconds an epoch of 15 policies, in shares and one after the other, and how many times faster the shares are.

    The plain fit is measured with a thread for each core, and with one: small products gain little from two, and lose
    on a busy machine. The ratio of a round is to the faster of both.
    """
    (frames, tests), batch = POLICY_FRAMES[size], POLICY_BATCHES[size]
    train, test = latents(frames, 0), latents(tests, 1)
    seconds: dict[str, list[float]] = {"ours": [], "sequential": [], "sequential_one_thread": []}
    ratios = []
    seconds_of_an_epoch(engine, *(latents(frames, 0) for frames in (batch, 100)), batch, 5)  # workers load libraries
    for turn in range(POLICY_ROUNDS):
        if turn and time.monotonic() - began > LATEST["round"]:
            break
        torch.set_num_threads(cores())
        plain_epochs = [SEEDS * epoch for epoch in plain.fit_policy(train, test, batch, POLICY_EPOCHS)]
        torch.set_num_threads(1)
        ours = seconds_of_an_epoch(engine, train, test, batch, STACKED_EPOCHS[size])
        one_thread = [SEEDS * epoch for epoch in plain.fit_policy(train, test, batch, POLICY_EPOCHS)]
        ratios.append(float(min(np.median(plain_epochs), np.median(one_thread)) / ours))
        for name, values in zip(seconds, ([ours], plain_epochs, one_thread), strict=True):
            seconds[name] += values
    limit = floor(policy_work(), "fp32", limits)
    evaluated = 2 * tests * sum(a * b for widths in WIDTHS.values() for a, b in itertools.pairwise(widths))
    epoch = SEEDS / WORKERS * (frames / limit["per_s"] + evaluated / limits["fp32_multiplications_per_s"])
    median, one_thread_median = (float(np.median(seconds[name])) for name in ("ours", "sequential_one_thread"))
    return {
        "frames": [frames, tests],
        "batch": batch,
        "seeds": SEEDS,
        "shares": WORKERS,
        "epochs": STACKED_EPOCHS[size],
        "seconds_per_epoch": {name: spread(values) for name, values in seconds.items()},
        "ratio_to_sequential": spread(ratios),
        "ratio_to_sequential_one_thread": one_thread_median / median,
        "floor": limit | {"seconds_per_epoch": epoch, "reached": epoch / median},
    }


# --- main -----------------------------------------------------------------------------------------------------------


def machine() -> Numbers:
    """Return the machine that measured."""
    made_by = provenance()
    return {
        "cpu": made_by["cpu"],
        "cores": made_by["cores"],
        "threads": 1,
        "platform": made_by["platform"],
        "python": made_by["python"],
        "packages": {name: made_by["packages"].get(name) for name in PACKAGES},
        "commit": made_by["commit"],
        "load_before": os.getloadavg()[0],
    }


def show(result: Numbers) -> None:
    """Print the tables of `benchmarks/README.md`."""

    def cell(numbers: Numbers | None) -> str:
        return "-" if numbers is None else f"{numbers['median']:,.0f} ({numbers['low']:,.0f} to {numbers['high']:,.0f})"

    print("\n| heads, batch | ours | bare loop | template | template bf16 | to bare | to templates | floor | reached |")
    print("|---|---|---|---|---|---|---|---|---|")
    for each in result["encoder"]["configurations"]:
        rates = (cell(numbers) for numbers in each["images_per_s"].values())
        limit, pairs, bf16 = each["floor"], each["ratio_to_bare"], each["ratio_to_template_bf16"]
        print(
            f"| `{each['heads']}`, {each['batch']} | {' | '.join(rates)} "
            f"| {pairs['median']:.3f} ({pairs['low']:.3f} to {pairs['high']:.3f}) "
            f"| {each['ratio_to_template']:.2f} / {'-' if bf16 is None else f'{bf16:.2f}'} "
            f"| {limit['per_s']:,.0f} ({limit['bound']}) | {100 * limit['reached']:.0f} % |"
        )
    print("\n| policies | ours | 15 fits | 15 fits, one thread | ratio | floor | reached |")
    print("|---|---|---|---|---|---|---|")
    for size in POLICY_FRAMES:
        each = result["policies"][size]
        seconds = (f"{n['median']:.2f} ({n['low']:.2f} to {n['high']:.2f})" for n in each["seconds_per_epoch"].values())
        ratio = each["ratio_to_sequential"]
        print(
            f"| {size}, batch {each['batch']} | {' | '.join(seconds)} "
            f"| {ratio['median']:.1f} ({ratio['low']:.1f} to {ratio['high']:.1f}) "
            f"/ {each['ratio_to_sequential_one_thread']:.1f} "
            f"| {each['floor']['seconds_per_epoch']:.2f} | {100 * each['floor']['reached']:.0f} % |"
        )
    shown = ("machine", "limits", "memory_bytes", "skipped", "seconds")
    print(json.dumps({name: result[name] for name in shown}, indent=1))
    print(f"reports and checkpoints: {100 * result['encoder']['reporting_share']:.2f} % at most")


def main() -> None:
    """Measure, print, and keep the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="try everything on almost no data; keep nothing")
    parser.add_argument("--policies", action="store_true", help="only the policies; of the rest, keep the last result")
    parser.add_argument("--memory", metavar="PRECISION", help="measure the memory of training, as the others do")
    options = parser.parse_args()
    if options.quick:
        BATCHES.update(laptop=16, paper=64)
        FRAMES.update(laptop=(64, 16), paper=(128, 32))
        POLICY_FRAMES.update(laptop=(1000, 250), paper=(2048, 500))
        STACKED_EPOCHS.update(laptop=5, paper=5)
    if options.memory:
        train_for_memory(options.memory)
        return
    began = time.monotonic()
    torch.set_num_threads(1)
    if options.policies:
        result: Numbers = json.loads(RESULT.read_text())
    else:
        result = {"machine": machine(), "limits": peaks(256 if options.quick else 2048)}
        result["skipped"] = [] if has_bf16() else ["all of bf16: this processor does not multiply bf16 matrices itself"]
        for reason in result["skipped"]:
            print(f"left out: {reason}", file=sys.stderr)
        if not options.quick:
            use_fewer_frames()
        result["encoder"] = encoders(result["limits"], began, result["skipped"])
        result["memory_bytes"] = {"bf16": memory("bf16") if has_bf16() else None, "fp32": memory("fp32")}
    with scratch_engine(WORKERS) as engine:
        sizes = {size: policies(engine, size, result["limits"], began) for size in POLICY_FRAMES}
    worst = min(each["ratio_to_sequential"]["median"] for each in sizes.values())
    measured = machine()
    told = {name: measured[name] for name in ("cpu", "commit", "load_before")}  # of --policies, too
    result["policies"] = {"ratio_to_sequential": worst, **told, **sizes}
    if not options.policies:
        result["seconds"] = round(time.monotonic() - began, 1)
    show(result)
    if not options.quick:
        RESULT.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
