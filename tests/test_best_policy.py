"""Tests during training, and evaluate: the policy that was best, and the figures of any."""

import json
import math
import shutil
from dataclasses import replace

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs import GymEnv

from torchrl_l2c2.experiment import (
    Experiment,
    ExperimentConfig,
    PPORPEConfig,
    TaskConfig,
    evaluate_policy,
    load_policy,
)
from torchrl_l2c2.experiment.analysis import diagnosis
from torchrl_l2c2.experiment.analysis import video as films
from torchrl_l2c2.experiment.cli import diagnose, evaluate, export, video
from torchrl_l2c2.experiment.cli.evaluate import main
from torchrl_l2c2.experiment.run import policies
from torchrl_l2c2.experiment.run.checkpoints import list_checkpoints, load_checkpoint
from torchrl_l2c2.experiment.run.evaluation import Evaluation

# What each command begins with. The modules are imported before a test replaces a function.
LOADS = (
    (policies, "load_policy"),
    (diagnosis, "diagnose_run"),
    (films, "play_pictures"),
)

TASK = TaskConfig("pendulum", "Pendulum-v1", episodes=6, max_steps=40)
FEW_UPDATES = {"task": TASK, "algorithm": PPORPEConfig(replay_ratio=1.0), "compile": False}


def run(folder, **settings):
    chosen = {"test_episodes": 2, "checkpoint_interval": 0.0} | settings
    experiment = Experiment(ExperimentConfig(**FEW_UPDATES | chosen), folder)
    experiment.train()
    experiment.finish(experiment.test())
    experiment.close()
    return experiment


def without_clock(experiment):
    return [
        {k: repr(v) for k, v in row.items() if k != "frames_per_second"}
        for row in experiment.metrics
    ]


def test_the_best_policy_of_the_tests_during_training_is_kept(tmp_path):
    """It plays the tests' episodes as it did when it was the best one; training is as without."""
    experiment = run(tmp_path / "with", evaluate_every=2)
    tests = json.loads((tmp_path / "with" / "evaluations.json").read_text())
    assert [test["episode"] for test in tests] == [2, 4, 6]
    best = max(tests, key=lambda test: test["return_mean"])
    kept = torch.load(tmp_path / "with" / "policy_best.pt", weights_only=True)
    only = run(tmp_path / "till_then", task=replace(TASK, episodes=best["episode"]))
    assert all(kept[k].equal(v) for k, v in only.agent.policy.state_dict().items())
    without = run(tmp_path / "without")
    assert without_clock(experiment) == without_clock(without)
    assert not (tmp_path / "without" / "evaluations.json").exists()


@pytest.mark.slow
def test_tests_during_training_are_continued_with_the_run(tmp_path):
    """None is lost and none comes twice."""
    whole = run(tmp_path / "whole", evaluate_every=2)
    run(tmp_path / "parts", evaluate_every=2, task=replace(TASK, episodes=3))
    parts = run(tmp_path / "parts", evaluate_every=2)
    written = [(tmp_path / name / "evaluations.json").read_text() for name in ("whole", "parts")]
    assert written[0] == written[1]
    assert whole._best_policy.tests == parts._best_policy.tests


def test_a_run_without_tests_plays_none():
    """And a test of none is asked for in vain."""
    experiment = Experiment(ExperimentConfig(**FEW_UPDATES, test_episodes=0))
    with pytest.raises(ValueError, match="episodes must be at least 1, got 0"):
        experiment.test()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("run")
    run(path, evaluate_every=3)
    return path


def evaluated(folder, *arguments):
    main([str(folder), "--episodes", "3", "--output", str(folder / "result.json"), *arguments])
    return json.loads((folder / "result.json").read_text())


def test_evaluate_plays_as_it_is_told(folder):
    """Number, seed, noise and samples change the figures; the same arguments give the same."""
    first = evaluated(folder, "--seed", "5")
    assert len(first["episodes"]["returns"]) == first["summary"]["episodes"] == 3
    assert first == evaluated(folder, "--seed", "5")
    for other in (["--seed", "6"], ["--noise", "0.5"], ["--sampled"]):
        # The last of two seeds counts.
        differs = evaluated(folder, "--seed", "5", *other)["episodes"]["action_variations"]
        assert differs != first["episodes"]["action_variations"]


def test_without_a_seed_evaluate_plays_the_runs_own_test(folder):
    """Its samples, too."""
    own = Experiment(ExperimentConfig(**FEW_UPDATES))
    own.load_state_dict(load_checkpoint(list_checkpoints(folder)[0]))
    for arguments, sampled in (([], False), (["--sampled"], True)):
        returns = own.test(3, sampled=sampled).returns
        assert evaluated(folder, *arguments)["episodes"]["returns"] == returns


def test_the_summary_by_hand():
    """Returns of 1 and 3, action variations of 2 and 6."""
    summary = Evaluation([1.0, 3.0], [2.0, 6.0], [5, 5]).summary()
    assert (summary["return_mean"], summary["return_std"]) == (2.0, 1.0)
    assert (summary["action_variation_mean"], summary["action_variation_std"]) == (4.0, 2.0)


@pytest.mark.parametrize(
    ("output", "told"),
    [
        ("file/x", r"the folder '.*file' cannot be written to .*; choose another"),
        ("folder", "expected a file, got the folder"),
    ],
)
def test_what_could_not_be_written_is_refused_before_it_is_played(
    folder, tmp_path, monkeypatch, output, told
):
    """By all commands that write what they played."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    for ending in ("json", "html"):
        (tmp_path / f"folder.{ending}").mkdir()
    for module, name in LOADS:
        monkeypatch.setattr(module, name, None)
    with pytest.raises(SystemExit, match=f"error: .*{told}"):
        main([str(folder), f"--output={output}.json"])
    with pytest.raises(SystemExit, match=f"error: .*{told}"):
        diagnose.main([str(folder), f"--output={output}.html"])


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("file/x.mp4", r"the folder '.*file' cannot be written to"),
        ("x.foo", r"Expected a file that ends in .*\.mp4, got 'x.foo'"),
    ],
)
def test_a_video_that_could_not_be_written_is_refused_before_it_is_played(
    folder, tmp_path, monkeypatch, name, told
):
    """With the endings that are possible."""
    pytest.importorskip("imageio_ffmpeg")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    for module, loads in LOADS:
        monkeypatch.setattr(module, loads, None)
    with pytest.raises(SystemExit, match=f"error: .*{told}"):
        video.main([str(folder), f"--output={name}"])


def test_the_summary_is_json_and_is_told_before_anything_is_written(folder, capsys, monkeypatch):
    """What is no number, such as a measure of too short an episode, is null."""
    figures = {"return_mean": 1.0, "roughness_mean": math.nan}
    monkeypatch.setattr(Evaluation, "summary", lambda self: figures)
    monkeypatch.setattr("torchrl_l2c2.experiment.run.files.write_json", broken)
    with pytest.raises(SystemExit, match="error: no space left"):
        main([str(folder), "--episodes", "1", "--output", str(folder / "result.json")])
    told = json.loads(capsys.readouterr().out, parse_constant=pytest.fail)
    assert told == {"return_mean": 1.0, "roughness_mean": None}


def test_a_closed_output_does_not_prevent_the_file(folder, monkeypatch):
    """As in ``evaluate FOLDER --output result.json | head -0``: the episodes took minutes."""

    def closed(*_, **__):
        raise BrokenPipeError

    (folder / "result.json").unlink(missing_ok=True)
    monkeypatch.setattr(evaluate, "print", closed, raising=False)
    monkeypatch.setattr("os.dup2", lambda *_: None)  # pytest's own output stays open.
    with pytest.raises(SystemExit) as ended:
        main([str(folder), "--episodes", "2", "--output", str(folder / "result.json")])
    assert ended.value.code == 1
    written = json.loads((folder / "result.json").read_text())
    assert len(written["episodes"]["returns"]) == 2 and written["arguments"]["seed"] >= 10**6


def broken(path, value):
    raise OSError("no space left")


def test_sensitivity_to_noise_is_among_the_measures():
    """Half the square of .01 times the slope of a linear policy, about."""
    policy = TensorDictModule(lambda seen: 0.3 * seen[..., 2:], ["observation"], ["action"])
    measures = evaluate_policy(policy, GymEnv("Pendulum-v1"), 2, max_steps=200).measures
    first, second = measures["noise_sensitivity"]
    assert first == pytest.approx(second, rel=1e-3)
    assert first == pytest.approx(0.5 * (0.3 * 0.01) ** 2, rel=0.2)


def test_numbers_that_are_not_finite_end_every_command_in_one_line(folder, monkeypatch):
    """As what the task or the policy gave is not the command's fault."""

    def diverged(*_, **__):
        raise FloatingPointError("reward is not finite at frame 5")

    for command, (module, name) in zip((main, diagnose.main, video.main), LOADS, strict=True):
        monkeypatch.setattr(module, name, diverged)
        with pytest.raises(SystemExit, match="error: reward is not finite at frame 5"):
            command([str(folder)])


def test_evaluate_refuses_what_cannot_be(folder, tmp_path):
    """In one line."""
    with pytest.raises(SystemExit, match="noise_scale must be at least 0 and finite, got -1"):
        evaluated(folder, "--noise", "-1")
    with pytest.raises(SystemExit, match="is not a run folder"):
        main([str(tmp_path)])
    for command in (main, diagnose.main):
        with pytest.raises(SystemExit, match="error: seed must be at least 0 and below"):
            command([str(folder), "--seed", "-1"])


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("policy.pt", b""),
        ("policy.pt", b"hello\n"),
        ("config.json", b""),
        ("config.json", b"[]"),
        ("config.json", b'{"seed": 0}'),
        ("config.json", b"\xff"),
    ],
)
def test_a_damaged_file_is_named(folder, tmp_path, name, content):
    """In one line, by every command that loads a policy."""
    shutil.copytree(folder, tmp_path / "run")
    (tmp_path / "run" / name).write_bytes(content)
    for command in (main, diagnose.main, video.main, export.main):
        with pytest.raises(SystemExit, match=rf"error: .*run/{name} .*restore it"):
            command([str(tmp_path / "run")])


def test_the_folder_says_how_to_load_its_policy(folder):
    """Its own lines run, and name every file."""
    text = (folder / "README.txt").read_text()
    lines = [line[4:] for line in text.splitlines() if line.startswith("    ")]
    code = [line for line in lines if not line.startswith("python")]
    names = {"__name__": "readme"}
    exec("\n".join(code).replace("path of this folder", str(folder)), names)
    assert names["rollout"]["action"].shape == (40, 1)
    for path in folder.iterdir():
        if not path.name.startswith((".", "checkpoint", "result", "README")):
            assert path.name in text


def test_a_policy_is_loaded_without_a_draw_from_the_global_generator(folder):
    """What a notebook draws does not depend on whether it has loaded one before."""
    before = torch.get_rng_state()
    load_policy(folder)
    assert torch.get_rng_state().equal(before)


def test_the_best_policy_is_loaded_where_there_is_one(folder, tmp_path):
    """And missed where there is none."""
    kept = torch.load(folder / "policy_best.pt", weights_only=True)
    policy = load_policy(folder, best=True)[0]
    assert all(kept[k].equal(v) for k, v in policy.state_dict().items())
    shutil.copytree(folder, tmp_path / "without", ignore=shutil.ignore_patterns("policy_best.pt"))
    with pytest.raises(FileNotFoundError, match="with evaluate_every=N, in another folder"):
        load_policy(tmp_path / "without", best=True)
