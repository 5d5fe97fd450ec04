"""A sweep on many machines: a scheduler and workers in folders of their own, over TLS, and what they survive."""

import datetime as dt
import ipaddress
import signal
import sys
import time
from collections import Counter

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from tests.support.processes import CommandProcess, sweep, sweep_command
from tests.support.run_database import run_database
from tests.support.servers import LOOPBACK, free_port
from tests.support.sweeps import TINY_SWEEP, assert_same_outcome, working_folder

pytestmark = pytest.mark.stress


def make_certificates(folder):
    """Write ca.pem, cert.pem and key.pem: one authority, and one certificate for every role."""
    folder.mkdir()
    now = dt.datetime.now(dt.UTC)

    def certify(name, issuer, issuer_key, key, *, authority):
        builder = (
            x509.CertificateBuilder()
            .subject_name(x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, name)]))
            .issuer_name(x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, issuer)]))
            .public_key(key.public_key())
            .serial_number(x509.random_serial_number())
            .not_valid_before(now - dt.timedelta(days=1))
            .not_valid_after(now + dt.timedelta(days=1))
            .add_extension(x509.BasicConstraints(ca=authority, path_length=None), critical=True)
            .add_extension(
                x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address(LOOPBACK))]), critical=False
            )
        )
        return builder.sign(issuer_key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)

    authority_key, key = (ec.generate_private_key(ec.SECP256R1()) for _ in range(2))
    own = certify("test authority", "test authority", authority_key, authority_key, authority=True)
    (folder / "ca.pem").write_bytes(own)
    (folder / "cert.pem").write_bytes(certify("study", "test authority", authority_key, key, authority=False))
    encoding = (serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    (folder / "key.pem").write_bytes(key.private_bytes(*encoding))
    return folder


class Cluster:
    """Runs a scheduler and three workers with their nannies, each started as a user starts it on its machine."""

    def __init__(self, folder):
        self.folder, self.port = folder, free_port()
        self.certificates = make_certificates(folder / "certificates")
        self.address = f"tls://{LOOPBACK}:{self.port}"
        self.words = ["--cluster", self.address, "--certificates", str(self.certificates)]
        self.scheduler = self.start_scheduler()
        self.workers = [self.start_worker(number) for number in range(3)]

    def dask(self, folder, role, *words):
        folder.mkdir(exist_ok=True)
        pems = {"--tls-ca-file": "ca.pem", "--tls-cert": "cert.pem", "--tls-key": "key.pem"}
        tls = [word for option, file in pems.items() for word in (option, str(self.certificates / file))]
        return CommandProcess(folder, sys.executable, "-m", "dask", *words, *tls, role=role)

    def start_scheduler(self):
        words = ["scheduler", "--protocol", "tls", "--host", LOOPBACK, "--port", str(self.port), "--no-dashboard"]
        return self.dask(self.folder / "scheduler", "scheduler", *words)

    def start_worker(self, number):
        words = ["worker", self.address, "--nworkers", "1", "--nthreads", "1", "--host", LOOPBACK, "--no-dashboard"]
        return self.dask(self.folder / f"machine{number}", "nanny", *words, "--local-directory", "scratch")

    def stop(self):
        for run in (self.scheduler, *self.workers):
            run.send(signal.SIGKILL, *run.roles())


@pytest.fixture
def cluster(tmp_path):
    machines = Cluster(tmp_path)
    yield machines
    machines.stop()


def test_three_machines_and_many_kills_end_with_the_table_of_one(undisturbed, cluster, tmp_path):
    """Kills a worker, a nanny, the scheduler and the client; every worker makes the frames in a folder of its own."""
    folder = working_folder(tmp_path / "client")
    kills = Counter()

    def begin():
        return CommandProcess(folder, *sweep_command(*TINY_SWEEP, "--baselines", "[]", *cluster.words))

    def kill(run, *roles):
        pids = [pid for role in roles for pid in run.pids(role)]
        kills["/".join(roles)] += run.send(signal.SIGKILL, *pids)

    run = begin()
    assert run.wait_for(lambda: run_database(folder).cell_counts()["RUNNING"]), run.output
    kill(cluster.workers[0], "worker")
    time.sleep(1)
    kill(cluster.workers[1], "nanny", "worker")
    cluster.workers[1] = cluster.start_worker(1)
    assert run.wait_for(lambda: run_database(folder).digests()), run.output
    kill(cluster.scheduler, "scheduler")
    code = run.wait()
    assert code == 2, run.output
    assert "the scheduler" in run.output
    assert "went away" in run.output
    assert "Traceback" not in run.output
    finished = set(run_database(folder).digests())

    cluster.scheduler.wait()
    cluster.scheduler = cluster.start_scheduler()
    for number, worker in enumerate(cluster.workers):
        kill(worker, "nanny", "worker")
        cluster.workers[number] = cluster.start_worker(number)
    run = begin()
    assert run.wait_for(lambda: run_database(folder).cell_counts()["RUNNING"]) or run.wait() == 0, run.output
    kill(run, "client")
    run.wait()
    assert finished <= set(run_database(folder).digests())

    run = begin()
    assert run.wait() == 0, run.output
    print("kills", dict(kills), "runs of cells", dict(run_database(folder).cell_counts()))
    assert_same_outcome(folder, undisturbed.folder)
    assert not (folder / "data/frames").exists()
    assert all((tmp_path / f"machine{number}/data/frames").exists() for number in range(3))


def test_certificates_that_do_not_match_are_one_clear_error(cluster, tmp_path):
    folder = working_folder(tmp_path / "client")
    other = make_certificates(tmp_path / "other")
    words = ["heads", "--profile", "tiny", "--cluster", cluster.address, "--certificates"]
    completed = sweep(folder, *words, str(other))
    assert completed.returncode == 2
    assert "no Dask scheduler answers" in completed.stderr
    assert "Traceback" not in completed.stderr
    assert str(other) not in completed.stdout


YAML = "class: {name}\narguments: {{cores: 1, memory: 2GB}}\nworkers: 2\n"


def test_a_batch_system_that_does_not_exist_is_one_clear_error(tmp_path):
    folder = working_folder(tmp_path / "client")
    (folder / "slurm.yaml").write_text(YAML.format(name="SLURMCluster"))
    completed = sweep(folder, "heads", "--profile", "tiny", "--cluster", "slurm.yaml")
    assert completed.returncode == 2
    assert "sbatch, which is not on this machine" in completed.stderr
    assert "Traceback" not in completed.stderr
