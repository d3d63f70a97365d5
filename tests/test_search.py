"""The search: what is searched, how a trial is run, and that it goes on."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import pytest

optuna = pytest.importorskip("optuna")

from small import own_nodes  # noqa: E402

from tests.test_front import forget  # noqa: E402
from tests.test_reports import make_config, make_run  # noqa: E402
from torchrl_l2c2.experiment import L2C2Config  # noqa: E402
from torchrl_l2c2.experiment.search import Search, main  # noqa: E402
from torchrl_l2c2.experiment.search_space import check_settings, read_space  # noqa: E402

ROOT = Path(__file__).parents[1]
GAINS = ("regularizer.lambda_max=tag(log, interval(0.1, 10))", "regularizer.beta=interval(0,1)")
SHORT = (
    "task.episodes=40", "task.max_steps=60", "algorithm.updates=4", "test_episodes=2",
    "compile=false", "checkpoint_interval=0", "seed=0,1",
)  # fmt: skip


@pytest.fixture(autouse=True)
def nodes():
    """A search checks its settings as the command reads them."""
    with own_nodes():
        yield


def test_hydras_grammar_says_what_is_searched():
    """Intervals and choices; sweeps are of every trial."""
    samples = "regularizer.num_samples=int(interval(1, 4))"
    choice = "regularizer=choice(caps,l2c2)"
    space, fixed = read_space([*GAINS, samples, choice, "seed=0,1", "task=ant"])
    assert space == {
        "regularizer.lambda_max": optuna.distributions.FloatDistribution(0.1, 10.0, log=True),
        "regularizer.beta": optuna.distributions.FloatDistribution(0.0, 1.0),
        "regularizer.num_samples": optuna.distributions.IntDistribution(1, 4),
        "regularizer": optuna.distributions.CategoricalDistribution(("caps", "l2c2")),
    }
    assert fixed == ["seed=0,1", "task=ant"]


def test_a_trial_is_a_sweep_in_a_folder_of_its_own(tmp_path):
    """With values of six digits, as names of folders have them."""
    search = Search(tmp_path, [*GAINS, "seed=0,1", "hydra/launcher=joblib"])
    values = {"regularizer.lambda_max": 0.12345678, "regularizer.beta": 1 / 3}
    assert search.command(3, values)[1:] == [
        *("-m", "torchrl_l2c2.experiment", "-m", "seed=0,1", "hydra/launcher=joblib"),
        *("regularizer.lambda_max=0.123457", "regularizer.beta=0.333333"),
        f"outputs={tmp_path}/trial_0003",
    ]


def test_a_search_goes_on_with_the_trial_that_was_lost(tmp_path):
    """Two at once take different ones; proposals do not depend on how often it was begun anew."""
    first = Search(tmp_path, GAINS)
    beginning = first.trials(3)
    number, values = next(beginning)
    assert number == 0
    # Another process would see the lock; here the study alone says that the trial was begun.
    beginning.close()
    again = dict(Search(tmp_path, GAINS).trials(3))
    assert again[0] == values and again.keys() == {0, 1, 2}
    whole = dict(Search(tmp_path / "whole", GAINS).trials(3))
    assert again == whole
    assert [json.loads(line)["op_code"] for line in (tmp_path / "journal.log").open()]


@pytest.mark.parametrize("line", ["{}", "[1]", "no JSON"])
def test_a_damaged_journal_is_named(tmp_path, line):
    """Whatever Optuna says of it."""
    (tmp_path / "journal.log").write_text(f"{line}\n")
    with pytest.raises(ValueError, match=r"journal.log is no journal of a search \("):
        Search(tmp_path, GAINS)


def test_searches_at_once_propose_as_one_does(tmp_path, monkeypatch):
    """Neither the same values twice nor more trials than there are to be."""
    ask = optuna.Study.ask

    def slowly(study, *args):
        time.sleep(0.2)  # in which another would ask
        return ask(study, *args)

    alone = dict(Search(tmp_path / "alone", GAINS).trials(4))
    monkeypatch.setattr(optuna.Study, "ask", slowly)
    searches = [Search(tmp_path / "shared", GAINS) for _ in range(3)]
    with ThreadPoolExecutor() as pool:
        found = list(pool.map(lambda search: list(search.trials(4)), searches))
    assert {number: values for each in found for number, values in each} == alone
    assert len(searches[0].study.get_trials()) == 4


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        (("seed=0,1",), "nothing is searched"),
        ((*GAINS, "task=ant"), "choose another folder"),
        # Without these a run leaves no results, whatever was tested during its training.
        ((*GAINS, "late_share=0", "test_episodes=0"), "choose test_episodes of at least 1, got 0"),
    ],
)
def test_what_cannot_be_searched_is_refused(tmp_path, settings, told):
    """And another search's folder is left as it is."""
    Search(tmp_path, GAINS)
    with pytest.raises(ValueError, match=told):
        Search(tmp_path, settings)
    with pytest.raises(SystemExit, match=f"error: .*{told}"):
        main([*settings, "--output", str(tmp_path)])


def test_a_trial_without_late_tests_is_scored_by_its_last_policies(tmp_path):
    """``late_share=0``, as presets have it; the late ones' where there are any."""
    search = Search(tmp_path, GAINS)
    begun = [search.study.ask(search.space).number for _ in range(3)]
    for number in begun[:2]:
        for seed in (0, 1):
            place = tmp_path / f"trial_{number:04d}" / str(seed)
            make_run(place, make_config(regularizer="l2c2", seed=seed), 10.0 + 4 * seed, 0.05)
    forget(tmp_path / "trial_0001", "test_return", "test_action_variation")
    # make_run: late policies' are 12, last policies' 20 more than the total, a mean of 12.
    assert search.tell(0) == pytest.approx({"return": 24.0, "action_variation": 0.062})
    assert search.tell(1) == pytest.approx({"return": 32.0, "action_variation": 0.07})
    assert [trial.values for trial in search.study.trials[:2]] == [
        pytest.approx(values) for values in ([24.0, 0.062], [32.0, 0.07])
    ]
    (tmp_path / "trial_0002").mkdir()
    with pytest.raises(ValueError, match=r"trial_0002 has no results; .* test_episodes of"):
        search.tell(2)


def test_a_trial_that_failed_counts_for_nothing(tmp_path, monkeypatch, capsys):
    """The seeds of it that did not fail would flatter it, in the front as for Optuna."""
    ends = {0: 0, 1: 1, 2: 0}  # exit statuses; one run of the second trial has ended

    def sweep(command):
        number = int(command[-1][-4:])
        for seed in (0, 1)[: 1 if ends[number] else 2]:
            config = make_config(regularizer="l2c2", seed=seed)
            own = L2C2Config(lambda_min=0.1 * (number + 1), lambda_max=10.0)
            place = tmp_path / f"trial_{number:04d}" / str(seed)
            make_run(place, replace(config, regularizer=own), 99.0 * number, 0.05)
        return ends[number]

    monkeypatch.setattr("torchrl_l2c2.experiment.search.run_sweep", sweep)
    main([*GAINS, "--output", str(tmp_path), "--trials", "3"])
    told = capsys.readouterr().out
    assert "failed, and count for nothing: trial_0001" in told
    page = (tmp_path / "report" / "report.html").read_text()
    assert "Hellinger 0.1" in told + page and "Hellinger 0.3" in told
    assert "Hellinger 0.2" not in told + page


@pytest.mark.parametrize(
    ("setting", "told"),
    [
        ("regularizer.beta=interval(1,0)", r"'regularizer.beta=.*not smaller, got 1 to 0"),
        ("regularizer.beta=interval(0,inf)", r"'regularizer.beta=.*finite number .* got 0 to inf"),
        (
            "regularizer.beta=tag(log,interval(0,1))",
            r"'regularizer.beta=.*a logarithmic scale begins above 0, got 0\.",
        ),
        ("outputs=elsewhere", "outputs is the trials' own, below --output"),
        (
            "regularizer.bta=interval(0,1)",
            "regularizer.bta is not a setting; did you mean",
        ),
        ("regularizer.beta=interval(-2,-1)", r"regularizer.beta must be .* got -1.29289"),
        ("regularizer.num_samples=interval(1,3)", "num_samples must be a valid integer, got 2.41"),
        ("regularizer=choice(l2c2,lipsnet)", "Could not find 'regularizer/lipsnet'"),
        ("task.noise_scale=-1,0", "task.noise_scale must be .*got -1"),
    ],
)
def test_a_setting_that_cannot_be_is_refused_before_the_first_trial(tmp_path, setting, told):
    """In a line with its name; neither a folder nor a trial is made for it."""
    with pytest.raises(SystemExit) as ended:
        main(["algorithm.tau=interval(0,1)", setting, "--output", str(tmp_path / "search")])
    assert re.match(f"error: .*{told}", str(ended.value)) and "\n" not in str(ended.value)
    assert not list(tmp_path.iterdir())


def test_what_a_run_can_begin_with_is_searched():
    """Also up to an open end, and with what is about the launcher."""
    check_settings(["algorithm.gamma=interval(0,1)", *GAINS, "seed=range(2)", "hydra/launcher=x"])
    check_settings(["regularizer=glob(l2c2*)", "regularizer.beta=interval(0,1)"])
    check_settings(["regularizer.num_samples=int(interval(1,2))", "optimizer=choice(adam,adaterm)"])


def test_without_optuna_it_says_how_to_get_it(tmp_path, monkeypatch):
    """In one line."""
    monkeypatch.setattr("torchrl_l2c2.experiment.search.find_spec", lambda name: None)
    with pytest.raises(SystemExit, match=r"^error: Optuna is missing: pip install 'torchrl-l2c2"):
        main([*GAINS, "--output", str(tmp_path / "search")])


@pytest.mark.parametrize(
    ("option", "told"),
    [
        (("--trials", "0"), "--trials must be at least 1, got 0"),
        (("--sampler-seed", "-1"), "--sampler-seed must be at least 0, got -1"),
    ],
)
def test_options_out_of_range_are_named(tmp_path, capsys, option, told):
    """Before anything is made."""
    with pytest.raises(SystemExit):
        main([*GAINS, "--output", str(tmp_path / "search"), *option])
    assert told in capsys.readouterr().err and not list(tmp_path.iterdir())


@pytest.mark.parametrize("setting", ["foo", "regularizer.beta=interval(0,1", "a=interval(b,1)"])
def test_what_hydra_cannot_read_is_told_in_a_line(tmp_path, setting):
    """With what it was to be."""
    with pytest.raises(SystemExit) as ended:
        main(["seed=0,1", setting, "--output", str(tmp_path / "search")])
    assert str(ended.value).startswith(f"error: {setting!r} cannot be read: settings are NAME=")
    assert "\n" not in str(ended.value) and not list(tmp_path.iterdir())


def start(folder):
    command = [sys.executable, "-m", "torchrl_l2c2.experiment.search", *SHORT, *GAINS]
    with open(folder / "said", "a") as output:
        return subprocess.Popen(
            [*command, "--trials", "4", "--output", str(folder / "search")],
            stdout=output,
            stderr=output,
            start_new_session=True,
            env={**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)},
        )


@pytest.mark.slow
def test_a_stopped_search_ends_with_a_front(tmp_path):
    """Stopped in its second trial, and the same command again."""
    process = start(tmp_path)
    ends = time.monotonic() + 200
    while not list((tmp_path / "search").glob("trial_0001/**/checkpoint_*.pt")):
        assert time.monotonic() < ends and process.poll() is None
        time.sleep(0.1)
    process.send_signal(signal.SIGTERM)
    assert process.wait(60) == 128 + signal.SIGTERM, (tmp_path / "said").read_text()
    assert start(tmp_path).wait(500) == 0, (tmp_path / "said").read_text()
    said = (tmp_path / "said").read_text()
    assert said.count("trial_0001, 2 of 4: ") == 2 and "continuing after episode" in said
    study = Search(tmp_path / "search", [*SHORT, *GAINS]).study
    assert [trial.state.name for trial in study.trials] == ["COMPLETE"] * 4
    assert "Pareto front" in (tmp_path / "search" / "report" / "report.html").read_text()
    assert (tmp_path / "search" / "report" / "front_1_swingup.svg").exists()
