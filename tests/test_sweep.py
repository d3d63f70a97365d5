"""Sweeps, stopped and continued: real processes, real signals."""

import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from omegaconf import OmegaConf
from processes import start_train

from torchrl_l2c2.experiment.cli.arguments import check_launcher, check_one_value, check_sweep
from torchrl_l2c2.experiment.cli.sweep import ShareSweep, Sweep, begin_sweep
from torchrl_l2c2.experiment.errors import UserError
from torchrl_l2c2.experiment.run.checkpoints import list_checkpoints, load_checkpoint
from torchrl_l2c2.experiment.settings.fields import SettingError

ROOT = Path(__file__).parent.parent
SETTINGS = (
    "task=gymnasium", "task.env_id=Pendulum-v1", "task.max_steps=50", "algorithm.updates=4",
    "test_episodes=1",
)  # fmt: skip
LAUNCHERS = {"basic": [], "joblib": ["hydra/launcher=joblib", "hydra.launcher.n_jobs=2"]}


def start(folder, *overrides, log="said"):
    """The command in a session of its own, as a terminal has one."""
    folder.mkdir(exist_ok=True)
    (folder / log).write_text("")
    settings = (*overrides, *SETTINGS, f"outputs={folder / 'o'}")
    return start_train(*settings, output=folder / log, session=True)


def said(folder, log="said"):
    return (folder / log).read_text()


def wait_until(condition, seconds=120.0):
    ends = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < ends, "it did not happen"
        time.sleep(0.05)


def alive(session):
    """Processes of a session that are not yet gone."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == session and fields[0] != "Z":
            found.append(int(path.parent.name))
    return found


def runs(folder):
    return {path.parent.name: path.parent for path in (folder / "o").rglob("config.json")}


def episodes(folder):
    return len((folder / "metrics.csv").read_text().splitlines()) - 1


def begun(folder, least=1):
    files = list((folder / "o").rglob("metrics.csv"))
    return len(files) >= least and all(episodes(file.parent) >= 2 for file in files)


@pytest.mark.parametrize(
    ("launcher", "number"),
    [
        ("basic", signal.SIGINT),  # SIGTERM is test_resume's
        *(
            pytest.param(*each, marks=pytest.mark.slow)
            for each in (
                ("basic", signal.SIGTERM),
                ("joblib", signal.SIGINT),
                ("joblib", signal.SIGTERM),
            )
        ),
    ],
)
def test_an_interrupted_sweep_saves_ends_and_is_continued(tmp_path, launcher, number):
    """Its running jobs save, no other one begins, no process stays; the same command goes on."""
    length = [
        "-m",
        "task.episodes=3000",
        "seed=0,1,2",
        *LAUNCHERS[launcher],
        "compile=false",
        "checkpoint_interval=3600",
    ]
    running = 2 if launcher == "joblib" else 1
    process = start(tmp_path, *length)
    wait_until(lambda: begun(tmp_path, running))
    # Ctrl-C reaches all processes of the terminal.
    send = os.killpg if number == signal.SIGINT else os.kill
    send(process.pid, number)
    wait_until(lambda: "finishing the episode, then saving" in said(tmp_path), 1.5)
    assert process.wait(30) == 128 + number, said(tmp_path)
    wait_until(lambda: not alive(process.pid), 5)
    assert "Traceback" not in said(tmp_path)
    assert f"{number.name} ended the sweep; the same command continues it." in said(tmp_path)
    saved = {name: episodes(folder) for name, folder in runs(tmp_path).items()}
    assert len(saved) == running
    for folder in runs(tmp_path).values():
        newest = list_checkpoints(folder)[0]
        assert int(newest.stem.split("_")[1]) == episodes(folder)
    longest = max(saved.values()) + 1
    again = start(tmp_path, "-m", f"task.episodes={longest}", *length[2:])
    assert again.wait(200) == 0, said(tmp_path)
    assert {episodes(folder) for folder in runs(tmp_path).values()} == {longest}
    assert said(tmp_path).count("continuing after episode") == running


@pytest.mark.slow
def test_ctrl_c_while_compiling_saves(tmp_path):
    """The compiler does not hear it; the episode ends with its updates, and is saved."""
    kappa = f"algorithm.kappa={random.random()}"  # nothing of it is in the compiler's cache
    process = start(tmp_path, "task.episodes=100", "seed=9", "regularizer=none", kappa)
    wait_until(lambda: "compiling" in said(tmp_path) and len(alive(process.pid)) > 1)
    time.sleep(1)
    os.killpg(process.pid, signal.SIGINT)
    wait_until(lambda: "finishing the episode, then saving" in said(tmp_path), 3)
    assert process.wait(200) == 128 + signal.SIGINT, said(tmp_path)
    assert "SIGINT ended the training after episode" in said(tmp_path)
    (folder,) = runs(tmp_path).values()
    assert list_checkpoints(folder)
    wait_until(lambda: not alive(process.pid), 10)


@pytest.mark.slow  # with the other launcher it is test_experiment's
def test_the_failed_jobs_of_a_sweep_are_named_at_its_end(tmp_path):
    """Each in a line with its reason, after everything else; the others are finished."""
    sweep = "replay.capacity=300,100", "replay.batch_size=8,200", "task.episodes=2"
    process = start(tmp_path, "-m", *sweep, *LAUNCHERS["joblib"], "compile=false")
    assert process.wait(120) == 1, said(tmp_path)
    last = said(tmp_path).splitlines()[-1]
    assert last.startswith("failed: replay.capacity=100 replay.batch_size=200")
    assert "replay.capacity must" in last and "Traceback" not in said(tmp_path)
    assert len(list((tmp_path / "o").rglob("evaluation.json"))) == 3


def test_the_values_of_a_sweep_are_checked_before_its_first_run(tmp_path):
    """Not hours later, when their turn comes: one line for each, and no folder."""
    sweep = "seed=0,1,-1", "regularizer=l2c2,l2c3", "algorithm.gamma=0.9,1.9"
    process = start(tmp_path, "-m", *sweep, "logger=csv")
    assert process.wait(60) == 1
    first, second, third = said(tmp_path).splitlines()
    assert first.startswith("error: Expected regularizer to be one of ")
    assert second.startswith("error: seed must be greater than or equal to 0, got -1")
    assert third.startswith("error: algorithm.gamma must be less than 1, got 1.9")
    assert not (tmp_path / "o").exists()


def test_names_that_do_not_fit_each_other_stop_a_sweep_before_its_first_run(tmp_path):
    """Each value fits the first one of the other setting: only combinations show the mistake."""
    names = "algorithm=sac,td3", "regularizer.policy_distance=mean,kl", "regularizer=l2c2"
    process = start(tmp_path, "-m", *names, "seed=0,1", "task.episodes=2")
    assert process.wait(60) == 1
    (line,) = said(tmp_path).splitlines()
    assert line.startswith(
        "error: regularizer.policy_distance must not be kl with algorithm=td3, whose policy is "
        "deterministic and no distribution: choose mean."
    )
    assert not (tmp_path / "o").exists()


def test_a_process_that_waits_for_a_job_ends_with_its_sweep(tmp_path):
    """A launcher's worker that never got one, after the sweep was killed; not one of Slurm's."""
    begin = (
        "import os, subprocess, sys, time\n"
        "from torchrl_l2c2.experiment.cli.sweep import begin_sweep\n"
        "with begin_sweep():\n"
        "    wait = [sys.executable, '-c', 'import time; time.sleep(600)']\n"
        "    subprocess.Popen(wait)\n"
        "    of_slurm = subprocess.Popen(wait, env={**os.environ, 'SLURM_JOB_ID': '7'})\n"
        "    print(of_slurm.pid, flush=True)\n"
        "    time.sleep(600)\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", begin],
        stdout=subprocess.PIPE,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    of_slurm = int(process.stdout.readline())
    assert len(alive(process.pid)) == 4  # with the guard
    process.kill()
    process.wait()
    wait_until(lambda: alive(process.pid) == [of_slurm], 20)
    os.kill(of_slurm, signal.SIGKILL)


@pytest.mark.parametrize("name", ["ray", "slurm"])
def test_a_launcher_says_what_it_needs(name, monkeypatch):
    """Where its plugin is not installed."""
    monkeypatch.setattr("torchrl_l2c2.experiment.cli.arguments.find_spec", lambda plugin: None)
    with pytest.raises(SystemExit, match=rf"{name}_cluster needs an extra. .*\.\[{name}"):
        check_launcher(["train.py", "-m", f"hydra/launcher={name}_cluster"])
    check_launcher(["train.py", "-m", "hydra/launcher=joblib"])


@pytest.mark.parametrize(
    ("sweep", "told"),
    [
        ("seed=range(3,0)", "error: the sweep has no jobs: one of -m seed=range"),
        (
            "experiment=filters,pendulum",
            "error: experiment=filters,pendulum: each ",
        ),
        (
            "+experiment=glob(table3*)",
            "error: +experiment=glob(table3*): each ",
        ),
        ("experiment=[filters,pendulum]", "error: experiment=[filters,pendulum]: each "),
        (
            "optimizer.lr=interval(0,1)",
            "error: sweeps do not support intervals: use examples",
        ),
    ],
)
def test_a_sweep_of_nothing_says_so(sweep, told):
    """It ended as if all were done; what a glob is, Hydra alone knows."""
    with pytest.raises(SystemExit, match=re.escape(told)):
        check_sweep(["-m", sweep])
    check_sweep(["-m", "regularizer=glob(l2c2*)", "seed=0,1", "experiment=filters"])
    with begin_sweep(["-m", "regularizer=glob(l2c2*)"]) as begun:
        assert begun.status(2, {}) == "run 2"


def test_several_values_need_the_option_for_a_sweep():
    """A list within brackets is one value; what cannot be parsed, Hydra reports."""
    with pytest.raises(SystemExit, match=r"^error: seed=0,1: .* Add -m to train one run for each"):
        check_one_value(["seed=0,1", "algorithm.hidden=[3,4]", "--cfg=job"])
    check_one_value(["seed=0", "algorithm.hidden=[3,4]", "--config-dir", "folder"])


def test_a_sweep_that_is_refused_ends_and_leaves_nothing(tmp_path):
    """Whatever ends it, its folder is gone, by which its jobs elsewhere would know."""
    with pytest.raises(SystemExit), begin_sweep(["-m", "seed=0,1"]) as begun:
        begun.share(tmp_path)
        assert [*tmp_path.iterdir()]
        sys.exit("error")
    assert not [*tmp_path.iterdir()]


def test_a_sweep_whose_outputs_cannot_be_written_to_says_so_in_a_line(tmp_path):
    """And has not been stopped by anyone."""
    (tmp_path / "file").touch()
    where = OmegaConf.create({"hydra": {"sweep": {"dir": str(tmp_path / "file" / "outputs")}}})
    told = r"error: the folder '.*outputs' cannot be written to \(Not a directory\); choose another"
    with begin_sweep() as begun:
        with pytest.raises(SystemExit, match=told):
            ShareSweep().on_multirun_start(where)
        assert begun.stopped_by is None
    assert Sweep(tmp_path / "file" / "sweep", ("", 0), ()).stopped_by == signal.SIGTERM


@pytest.mark.parametrize("task", ["task", "task.env_id"])
def test_a_sweep_says_how_much_of_it_is_left(task):
    """By each task's mean of what is finished, and the tasks' mean for one of which none is."""
    with begin_sweep(["-m", "seed=0,1,2", "~logger"]) as begun:
        params = {"seed": "range(0,18)", task: "a,b,c", "regularizer": "none,caps"}
        assert begun.status(1, params) == "run 1 of 18"
        # Of a 30 minutes and 50, of b 20; then c takes 30, and five of each are 7.5 hours.
        for number, seconds in enumerate((1800.0, 3000.0, 1200.0, float("nan"))):
            begun.add_finished(number, Path("run"), seconds)
        assert begun.status(5, params) == "run 5 of 18, about 7.0 h left"
        # As a job sees it, in whatever process.
        with begun.job(4, "seed=0"), begun.job(5, "seed=0"):
            status = Sweep.of_this_job().status(7, params)
            assert status == "run 7 of 18, about 3.0 h left"
        assert begun.status(18, params) == "run 18 of 18, about 30 min left"


def test_a_job_that_did_not_end_is_named_and_known_when_it_begins_again(tmp_path):
    """Unless it was stopped; one that failed or ended is not."""
    with begin_sweep() as begun:
        begun.share(tmp_path)
        with pytest.raises(KeyboardInterrupt), begun.job(0, "seed=0") as before:
            assert not before
            raise KeyboardInterrupt
        with begun.job(1, "seed=1"):
            Sweep.of_this_job().add_failure(1, "seed=1", "no room")
        ((lost, why), failed) = begun.failures
        assert lost == "seed=0" and why.startswith("lost with its process or machine")
        assert failed == ("seed=1", "no room")
        with begun.job(0, "seed=0") as before:
            assert before
        assert begun.failures == [("seed=1", "no room")]


def test_two_jobs_do_not_share_a_folder(tmp_path):
    """The second would take the place of the first's results; the same job again may go on."""
    with begin_sweep() as sweep:
        sweep.claim(0, tmp_path / "seed_0")
        sweep.claim(1, tmp_path / "seed_1")
        sweep.claim(0, tmp_path / "seed_0")
        with pytest.raises(
            SettingError, match=r"differ between jobs 0 and 2 .*seed_0: their settings"
        ):
            sweep.claim(2, tmp_path / "seed_0")


def test_a_job_of_a_sweep_that_ended_does_not_begin(tmp_path):
    """One that waited in a cluster's queue; and the folder that they shared is gone."""
    with begin_sweep() as begun:
        begun.share(tmp_path)
        job = Sweep.of_this_job()
        assert job.stopped_by is None
    assert job.stopped_by == signal.SIGTERM
    assert list(tmp_path.iterdir()) == []


def test_a_machine_without_the_outputs_is_named(tmp_path):
    """It would write where nobody looks."""
    with begin_sweep() as begun:
        begun.share(tmp_path / "outputs")
        (tmp_path / "outputs").rename(tmp_path / "moved")
        with pytest.raises(UserError, match=r"outputs' does not exist on .* all machines share"):
            Sweep.of_this_job()


@pytest.mark.slow
def test_two_sweeps_share_a_folder(tmp_path):
    """At the same time: every run is made by one of them, and the same command finds all done."""
    command = ("-m", "seed=0,1,2,3", "task.episodes=40", "compile=false")
    alone, both = tmp_path / "alone", tmp_path / "both"
    assert start(alone, *command).wait(500) == 0, said(alone)
    pair = [start(both, *command, log=log) for log in ("one", "other")]
    ended = [process.wait(500) for process in pair]
    told = said(both, "one") + said(both, "other")
    assert 1 in ended and "in use by process" in told and "Traceback" not in told, told
    assert start(both, *command).wait(500) == 0, said(both)
    assert "episode 1 of" not in said(both)
    ours, theirs = runs(both), runs(alone)
    assert ours.keys() == theirs.keys() and len(ours) == 4
    for seed in ours:
        assert numbers(ours[seed]) == numbers(theirs[seed])


def numbers(folder):
    state = load_checkpoint(list_checkpoints(folder)[0])["loss"]
    return {name: value.tolist() for name, value in state.items() if hasattr(value, "tolist")}


@pytest.mark.slow
@pytest.mark.parametrize("sweep", [False, True], ids=("single", "joblib"))
def test_what_is_ended_at_random_times_ends_with_the_same_numbers(tmp_path, sweep):
    """Up to twenty SIGKILLs, SIGTERMs and Ctrl-Cs, and then the same command to the end."""
    choose, times = random.Random(0), 0
    command = ["-m", "seed=0,1,2,3", *LAUNCHERS["joblib"]] if sweep else []
    episodes = 150 if sweep else 400
    command += [f"task.episodes={episodes}", "checkpoint_interval=0.5", "compile=false"]
    undisturbed = start(tmp_path / "undisturbed", *command)
    assert undisturbed.wait(580) == 0, said(tmp_path / "undisturbed")
    folder = tmp_path / "ended"
    while times < 20:
        process = start(folder, *command)
        time.sleep(choose.uniform(1, 14))
        if process.poll() is not None:  # A fast machine is done by now.
            break
        number = choose.choice((signal.SIGKILL, signal.SIGTERM, signal.SIGINT))
        if number == signal.SIGINT:
            os.killpg(process.pid, number)
        else:
            process.send_signal(number)
        process.wait(60)
        # Those of a killed process look for it, once they are there themselves.
        wait_until(lambda pid=process.pid: not alive(pid), 60)
        times += 1
    assert times > 3
    assert start(folder, *command).wait(580) == 0, said(folder)
    ours, theirs = runs(folder), runs(tmp_path / "undisturbed")
    assert ours.keys() == theirs.keys() and len(ours) == (4 if sweep else 1)
    for seed, run in ours.items():
        assert numbers(run) == numbers(theirs[seed]), seed
