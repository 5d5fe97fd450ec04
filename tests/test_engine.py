"""The engine of Dask on this machine, for real: results, signs of progress, killed workers, and closed doors.

One engine serves the module: two workers, and one that believes to have a GPU, which no task here touches.
"""

import gc
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from operator import mul
from pathlib import Path
from threading import Lock

import psutil
import pytest
import yaml

from study.compute import gpus
from study.compute.gpus import visible_gpus
from study.engine import cluster, dask_engine
from study.engine.cluster import cluster_engine, start_jobs
from study.engine.cluster_options import check_address
from study.engine.flows import TRIES, run_flow
from study.engine.local import local_engine
from study.errors import BadInputError
from study.stages import ENCODER, Batch, Task
from tests.support.listeners import run_and_record
from tests.support.processes import ROOT
from tests.support.servers import free_port

GPU = "7"


@pytest.fixture(scope="module")
def engine(tmp_path_factory):
    with local_engine(2, tmp_path_factory.mktemp("scratch"), [GPU]) as started:
        yield started
        alive = [child for child in psutil.Process().children() if child.status() != psutil.STATUS_ZOMBIE]
        left = [child for child in alive if "spawn_main" in " ".join(child.cmdline())]
    assert left
    assert psutil.wait_procs(left, timeout=30)[1] == []  # none outlives its engine


def flow(function, *argument_lists, **options):
    return (yield Batch([Task(ENCODER, function, arguments, **options) for arguments in argument_lists]))


# --- what workers do ------------------------------------------------------------------------------------------------


def square(number):
    return number**2


def work(steps, report):
    for step in range(1, steps + 1):
        report("log", step, {"loss": 1 / step})
        report("progress", step, steps)


def die(diary, times):
    """Record the run in a diary, and die the first `times` times."""
    with diary.open("a") as stream:
        stream.write("run\n")
    if len(diary.read_text().split()) <= times:
        os.kill(os.getpid(), signal.SIGKILL)
    return "alive"


def environment(name):
    time.sleep(0.2)  # so that every worker gets some
    return os.environ.get(name)


def deaf_threads():
    """Return, for each thread of this process, whether the kernel has SIGINT blocked."""
    masks = []
    for status in Path("/proc/self/task").glob("*/status"):
        lines = dict(line.split(":\t", 1) for line in status.read_text().splitlines() if ":\t" in line)
        masks.append(bool(int(lines["SigBlk"], 16) >> (signal.SIGINT - 1) & 1))
    return masks


# --- this machine ---------------------------------------------------------------------------------------------------


def test_results_come_from_other_processes_in_the_order_of_the_tasks(engine):
    events = run_and_record(engine, {name: flow(square, *((number,) for number in range(8))) for name in "ab"})
    assert events.products == {name: [number**2 for number in range(8)] for name in "ab"}
    processes = [process for _, _, process in events.starts]
    assert len(processes) == 16
    assert os.getpid() not in processes


def test_whatever_a_task_reports_is_delivered_before_its_end(engine):
    events = run_and_record(engine, {str(number): flow(work, (3,), reports=True) for number in range(12)})
    losses = [(name, epoch, metrics["loss"]) for name, _, epoch, metrics in events.logs]
    assert sorted(losses) == sorted((str(number), step, 1 / step) for number in range(12) for step in (1, 2, 3))
    assert Counter((done, total) for _, done, total in events.steps) == dict.fromkeys([(0, 1), (1, 3), (2, 3)], 12) | {
        (3, 3): 24
    }  # as told by the task, and by its end


@pytest.mark.parametrize("times", [1, TRIES - 1])
def test_a_task_whose_worker_is_killed_runs_again(engine, tmp_path, times):
    diary = tmp_path / "diary"
    assert run_flow(flow(die, (diary, times)), engine) == ["alive"]
    assert diary.read_text().split() == ["run"] * (times + 1)


def test_a_task_that_kills_every_worker_is_given_up_and_harms_no_other(engine, tmp_path):
    diary = tmp_path / "diary"
    events = run_and_record(
        engine, {"deadly": flow(die, (diary, 99)), **{name: flow(square, (3,), (4,)) for name in "abc"}}
    )
    assert events.products == {name: [9, 16] for name in "abc"}
    assert events.failures.keys() == {"deadly"}
    assert f"killed {TRIES} times" in events.failures["deadly"].reason
    assert events.failures["deadly"].exhausted
    assert events.retries == []  # Dask has tried often enough
    assert diary.read_text().split() == ["run"] * TRIES


def test_a_result_that_cannot_travel_fails_its_flow_only(engine):
    events = run_and_record(engine, {"back": flow(Lock, ()), "a": flow(square, (2,))})
    assert events.products == {"a": [4]}
    assert "pickle" in events.failures["back"].reason


def test_accelerated_tasks_run_where_the_gpu_is_seen(engine):
    assert engine.gpus() == 1
    visible = run_flow(flow(environment, *[("CUDA_VISIBLE_DEVICES",)] * 4, accelerated=True), engine)
    assert visible == [GPU] * 4


def test_a_gpu_whose_worker_restarts_is_waited_for(engine, tmp_path, monkeypatch):
    """A cell that was to be trained on a GPU must not end up on the CPU."""
    monkeypatch.setattr(dask_engine, "SIZE", 0.0)  # notices at once that the worker is gone
    dies = flow(die, (tmp_path / "diary", 1), accelerated=True)
    waits = flow(environment, *[("CUDA_VISIBLE_DEVICES",)] * 2, accelerated=True)
    assert run_and_record(engine, {"dies": dies, "waits": waits}).products == {"dies": ["alive"], "waits": [GPU, GPU]}


def test_a_process_that_ends_at_once_leaves_no_semaphores_and_says_nothing_of_them(tmp_path):
    code = (
        "import os, re; from pathlib import Path; from study.engine.local import local_engine\n"
        f"engine = local_engine(1, Path({str(tmp_path)!r}))\n"
        "print(*set(re.findall('/dev/shm/sem[.]\\\\S+', Path('/proc/self/maps').read_text())), flush=True)\n"
        "os._exit(130)"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stderr) == (130, "")
    assert ended.stdout.split()
    assert not any(Path(semaphore).exists() for semaphore in ended.stdout.split())


def test_a_worker_that_dask_has_given_up_is_replaced(tmp_path, monkeypatch):
    """On a busy machine a restart can take longer than Dask waits, and a task for the GPU would wait for ever."""
    monkeypatch.setattr(dask_engine, "SIZE", 0.5)
    monkeypatch.setitem(dask_engine.CONFIGURATION, "distributed.deploy.lost-worker-timeout", "1ms")
    with local_engine(1, tmp_path / "scratch", [GPU]) as engine:
        for accelerated in (True, False):
            diary = tmp_path / f"diary {accelerated}"
            assert run_flow(flow(die, (diary, 1), accelerated=accelerated), engine) == ["alive"]


def test_a_file_is_seen_by_workers_of_the_same_folder(engine, tmp_path):
    (tmp_path / "token").touch()
    assert engine.workers_see(tmp_path / "token")
    assert not engine.workers_see(tmp_path / "nothing")


def test_everything_listens_on_loopback_only(engine):
    processes = [psutil.Process(), *psutil.Process().children(recursive=True)]
    listening = [
        connection.laddr.ip
        for process in processes
        for connection in process.net_connections("inet")
        if connection.status == psutil.CONN_LISTEN
    ]
    assert len(listening) >= 4  # a scheduler and three workers
    assert set(listening) <= {"127.0.0.1", "::1"}


def test_workers_are_deaf_to_ctrl_c_and_this_process_is_not(engine):
    """A terminal sends it to all of them, and this one has to say what becomes of it."""
    masks = run_flow(flow(deaf_threads, (), (), ()), engine)
    assert all(masks)
    assert all(all(threads) for threads in masks)
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])


# --- a cluster ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "address",
    ["tcp://127.0.0.1:8786", "tcp://[::1]:8786", "tcp://localhost:8786", "tls://host:8786", "tls://10.0.0.1:1"],
)
def test_addresses_that_are_here_or_encrypted_are_accepted(address):
    check_address(address)


@pytest.mark.parametrize(
    ("address", "says"),
    [
        ("host:8786", "give a scheduler's address"),
        ("http://host:8786", "give a scheduler's address"),
        ("tls://", "give a scheduler's address"),
        ("tcp://host:8786", "not encrypted"),
        ("tcp://192.168.0.2:8786", "not encrypted"),
        ("tcp://me:secret@host:8786", r"tcp://\*\*\*@host:8786 is not on this machine"),
        ("tcp://localhost.example.org:8786", "not encrypted"),
    ],
)
def test_other_addresses_are_refused_before_anything_is_sent(address, says):
    with pytest.raises(BadInputError, match=says) as caught:
        cluster_engine(address)
    assert "secret" not in str(caught.value)


def test_an_address_where_nobody_answers_is_one_clear_error(monkeypatch):
    monkeypatch.setattr(cluster, "CONNECT", 0.5)
    with pytest.raises(BadInputError, match=r"no Dask scheduler answers at t.*start one with 'dask scheduler'"):
        cluster_engine(f"tcp://127.0.0.1:{free_port()}")


def test_certificates_that_are_missing_are_named(tmp_path):
    (tmp_path / "ca.pem").touch()
    with pytest.raises(BadInputError, match=r"has no cert\.pem, key\.pem; --certificates needs ca\.pem, cert\.pem"):
        cluster_engine("tls://127.0.0.1:8786", tmp_path)


def test_invalid_certificates_are_one_clear_error(tmp_path, monkeypatch):
    monkeypatch.setattr(cluster, "CONNECT", 0.5)
    for name in ("ca.pem", "cert.pem", "key.pem"):
        (tmp_path / name).write_text("none")
    with pytest.raises(BadInputError, match="--certificates"):
        cluster_engine(f"tls://127.0.0.1:{free_port()}", tmp_path)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ({"class": "SlurmCluster"}, "class.*'SlurmCluster'; choose from SLURMCluster, PBSCluster"),
        ({"class": "LocalCluster"}, "choose from SLURMCluster"),
        ({}, "choose from SLURMCluster"),
        ({"class": "SLURMCluster", "worker": 3}, "unknown setting 'worker'; choose from class, arguments, workers"),
        ({"class": "SLURMCluster", "workers": 0}, "'workers' a number of 1 or more"),
        ({"class": "SLURMCluster", "workers": "many"}, "'workers' a number of 1 or more"),
        ({"class": "SLURMCluster", "arguments": ["cores"]}, "'arguments' must be a mapping"),
        ({"class": "SLURMCluster", "arguments": {"security": None}}, "leave out 'security'"),
        ({"class": "SLURMCluster", "arguments": {"protocol": "tcp://"}}, "workers always connect over TLS"),
        ({"class": "SLURMCluster", "arguments": {"nonsense": 1}}, "SLURMCluster cannot be started.*nonsense"),
    ],
)
def test_a_file_that_describes_no_cluster_is_one_clear_error(tmp_path, monkeypatch, content, says):
    monkeypatch.chdir(tmp_path)
    sbatch = tmp_path / "bin/sbatch"  # what is wrong is the file
    sbatch.parent.mkdir()
    sbatch.touch(0o755)
    monkeypatch.setenv("PATH", str(sbatch.parent), prepend=os.pathsep)
    Path("batch.yaml").write_text(yaml.safe_dump(content))
    with pytest.raises(BadInputError, match=rf"batch\.yaml.*{says}"):
        cluster_engine("batch.yaml")


def test_a_file_that_is_missing_is_one_clear_error(tmp_path):
    with pytest.raises(BadInputError, match=r"nothing\.yaml"):
        cluster_engine(str(tmp_path / "nothing.yaml"))


def test_jobs_of_a_batch_system_work_over_tls(tmp_path, monkeypatch):
    """Dask-jobqueue's own local system stands for Slurm and the others."""
    from dask_jobqueue.local import LocalCluster  # noqa: PLC0415 - takes a second

    monkeypatch.chdir(tmp_path)
    (tmp_path / "installed").mkdir()  # the job's machine has the study, but not this module
    (tmp_path / "installed/study").symlink_to(ROOT / "study")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "installed"))
    with start_jobs(LocalCluster, {"memory": "1GB"}, 1, "batch.yaml") as engine:
        assert engine._address.startswith("tls://")  # noqa: SLF001
        assert run_flow(flow(mul, (5, 5), (6, 6)), engine) == [25, 36]
        events = run_and_record(engine, {"lacking": flow(square, (5,)), "a": flow(mul, (2, 2))})
    assert events.products == {"a": [4]}
    assert "No module named 'tests'" in events.failures["lacking"].reason
    assert (tmp_path / "data" / "tmp" / "certificates").stat().st_mode & 0o077 == 0
    del engine
    gc.collect()  # its certificates are removed with it, and their folder after this test


# --- GPUs -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("visible", "count", "device", "names"),
    [
        (None, 0, "auto", []),
        (None, 2, "auto", ["0", "1"]),
        (None, 2, "cuda", ["0", "1"]),
        (None, 2, "cuda:1", ["1"]),
        (None, 2, "cuda:2", []),
        (None, 2, "cpu", []),
        (None, 0, "mps", ["mps"]),
        ("", 0, "auto", []),
        ("3,5", 2, "auto", ["3", "5"]),
        ("3,5", 2, "cuda:1", ["5"]),
        ("GPU-a,GPU-b", 2, "cuda", ["GPU-a", "GPU-b"]),
    ],
)
def test_gpus_are_named_as_cuda_names_them(monkeypatch, visible, count, device, names):
    """What CUDA would count is given: there may be no GPU here."""
    monkeypatch.setattr("torch.cuda.device_count", lambda: count)
    monkeypatch.setattr(gpus, "GPU_DRIVERS", ("/dev/null",) if count else ())
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    if visible is not None:
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    assert visible_gpus(device) == names
