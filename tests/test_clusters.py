"""Sweeps by the launchers of clusters: a machine is lost midway, and the table is the same."""

import importlib.util
import json
import os
import signal
from pathlib import Path

import pytest

from tests.test_sweep import alive, episodes, numbers, runs, said, start, wait_until
from torchrl_l2c2.experiment.analysis.reports import read_runs, sweep_summary
from torchrl_l2c2.experiment.run.checkpoints import list_checkpoints

SWEEP = ("-m", "seed=0,1,2,3", "task.episodes=40", "compile=false", "checkpoint_interval=0")


def needs(package):
    missing = importlib.util.find_spec(package) is None
    return pytest.mark.skipif(missing, reason=f"needs {package}")


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The folder of the sweep in one go, in one process."""
    folder = tmp_path_factory.mktemp("undisturbed")
    assert start(folder, *SWEEP).wait(500) == 0, said(folder)
    return folder


def begun_in_the_middle(folder):
    """A run's folder and process, once it has saved some but far from all of its episodes."""
    found = []

    def some():
        for run in runs(folder).values():
            owner = run / ".lock_owner"
            if list_checkpoints(run) and owner.exists() and 3 <= episodes(run) <= 20:
                found.append((run, json.loads(owner.read_text())["pid"]))
        return found

    wait_until(some, 300)
    return found[0]


def assert_same(folder, other):
    """Parameters, every number of the table, and the table."""
    ours, theirs = runs(folder), runs(other)
    assert ours.keys() == theirs.keys() and len(ours) == 4
    for seed in ours:
        assert numbers(ours[seed]) == numbers(theirs[seed])
    tests = [[run.evaluation for run in read_runs(each)] for each in (folder, other)]
    assert tests[0] == tests[1]
    assert sweep_summary([folder / "o"]) == sweep_summary([other / "o"])


@needs("submitit")
@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGUSR2, signal.SIGKILL])
def test_a_lost_job_of_submitit_goes_on(tmp_path, undisturbed, number):
    """What is preempted, the engine begins again; what is killed, the same command."""
    command = (*SWEEP, "hydra/launcher=submitit_local", "hydra.launcher.timeout_min=30")
    sweep = start(tmp_path, *command)
    run, process = begun_in_the_middle(tmp_path)
    os.kill(process, number)
    ended = sweep.wait(500)
    if number == signal.SIGKILL:
        assert ended == 1
        wait_until(lambda: not alive(sweep.pid), 20)
        lines = said(tmp_path).splitlines()
        (failed,) = (line for line in lines if line.startswith(f"failed: seed={run.name[-1]} "))
        assert failed.endswith("the same command continues it")
        ended = start(tmp_path, *command).wait(500)
    assert ended == 0, said(tmp_path)
    assert "continuing after episode" in (run / "train.log").read_text()
    assert_same(tmp_path, undisturbed)


@pytest.fixture
def ray_cluster(tmp_path, monkeypatch):
    """A head that runs nothing and two machines of one core, which begin in another folder."""
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    monkeypatch.setenv("RAY_USAGE_STATS_ENABLED", "0")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))
    from ray.cluster_utils import Cluster

    memory = {"object_store_memory": 100_000_000}
    cluster = Cluster(
        initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False, **memory}
    )
    try:
        for _ in range(2):
            cluster.add_node(num_cpus=1, **memory)
        cluster.wait_for_nodes()
        yield cluster
    finally:
        cluster.shutdown()


@needs("hydra_plugins.hydra_ray_launcher")
@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_lost_machine_of_ray_is_made_up_for(tmp_path, undisturbed, ray_cluster, number):
    """Killed with its worker, the other one does the rest; asked to end, the worker saves first."""
    address = f"hydra.launcher.ray.init.address={ray_cluster.address}"
    sweep = start(tmp_path, *SWEEP, "hydra/launcher=ray_cluster", address)
    run, process = begun_in_the_middle(tmp_path)
    machines = {
        node.all_processes["raylet"][0].process.pid: node for node in ray_cluster.worker_nodes
    }
    machine = machines[parent(process)]
    os.kill(process, number)
    if number == signal.SIGKILL:
        ray_cluster.remove_node(machine, allow_graceful=False)
    assert sweep.wait(500) == 0, said(tmp_path)
    log = (run / "train.log").read_text()
    assert "continuing after episode" in log
    assert ("SIGTERM ended the training" in log) == (number == signal.SIGTERM)
    assert_same(tmp_path, undisturbed)


def parent(process):
    return int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1])
