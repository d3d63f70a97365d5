"""N episodes equal k episodes, a kill and N - k episodes: bit for bit."""

import contextlib
import csv
import hashlib
import importlib.metadata
import json
import re
import shutil
import signal
import sys
import time
import types
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
from processes import start_train

from torchrl_l2c2.experiment import (
    AdamConfig,
    CAPSConfig,
    Experiment,
    ExperimentConfig,
    L2C2Config,
    NoRegularizerConfig,
    PPOConfig,
    PPORPEConfig,
    TaskConfig,
    UniformReplayConfig,
)
from torchrl_l2c2.experiment.analysis.reports import find_runs, finished_run, read_runs
from torchrl_l2c2.experiment.cli.train import _log_errors
from torchrl_l2c2.experiment.errors import OtherRunError, warnings_as_lines
from torchrl_l2c2.experiment.run.checkpoints import (
    CheckpointError,
    list_checkpoints,
    load_checkpoint,
    save_checkpoint,
)
from torchrl_l2c2.experiment.run.continuation import check_same_settings
from torchrl_l2c2.experiment.run.files import write_json
from torchrl_l2c2.experiment.run.policies import load_policy
from torchrl_l2c2.experiment.run.progress import show_and_log
from torchrl_l2c2.experiment.settings.config import GROUPS

ROOT = Path(__file__).parent.parent
SWINGUP = TaskConfig(episodes=6, max_steps=60)
HOPPER = TaskConfig("hopper", "pybullet_envs_gymnasium:HopperBulletEnv-v0", 0.001, 6, 100)


def contents(folder):
    """What is in a folder's files, but for who uses it, and since when."""
    return {p: p.read_bytes() for p in folder.iterdir() if not p.name.startswith(".lock")}


# A tenth of the usual updates: two or so after each episode.
FEW_UPDATES = PPORPEConfig(replay_ratio=1.0)


def small(**settings):
    return ExperimentConfig(
        **{
            "task": SWINGUP,
            "algorithm": FEW_UPDATES,
            "compile": False,
            "test_episodes": 1,
            "checkpoint_interval": 0.0,
        }
        | settings
    )


@pytest.fixture(scope="module")
def first_ended(tmp_path_factory):
    """The folder of a run that was trained, and that of the same run with its results."""
    trained, ended = (tmp_path_factory.mktemp("first") / name for name in ("trained", "ended"))
    run = Experiment(small(), trained)
    run.train()
    shutil.copytree(trained, ended, ignore=shutil.ignore_patterns(".lock*"))
    run.close()
    run = Experiment(small(), ended)
    run.finish(run.test())
    run.close()
    return trained, ended


@pytest.fixture
def trained(first_ended, tmp_path):
    """A copy of the first, of the test's own."""
    return shutil.copytree(first_ended[0], tmp_path / "run")


@pytest.fixture
def ended(first_ended, tmp_path):
    """A copy of the second, likewise."""
    return shutil.copytree(first_ended[1], tmp_path / "run")


def parameter_hash(experiment):
    digest = hashlib.sha256()
    for name, tensor in sorted(experiment.agent.loss.state_dict().items()):
        if hasattr(tensor, "numpy"):
            digest.update(name.encode() + tensor.numpy().tobytes())
    return digest.hexdigest()


def lines(folder, late_tests=True):
    """The metrics, without the one that is a matter of the clock.

    Which policies are late depends on how long the run is to be: runs of different lengths are
    compared without their test episodes.
    """
    with open(folder / "metrics.csv", newline="") as file:
        return [
            {
                key: value
                for key, value in row.items()
                if key != "frames_per_second" and (late_tests or not key.startswith("test_"))
            }
            for row in csv.DictReader(file)
        ]


@pytest.mark.parametrize(
    "settings",
    [
        {"regularizer": L2C2Config()},
        {"regularizer": CAPSConfig(), "task": HOPPER, "algorithm": PPORPEConfig()},
        {"replay": UniformReplayConfig(batch_size=32), "optimizer": AdamConfig()},
        {
            "algorithm": PPORPEConfig(schedule="step", replay_ratio=3.0),
            "task": replace(SWINGUP, max_steps=30),
        },
        {
            # Three episodes of 30 frames end in two rollouts, ten frames before their end.
            "task": TaskConfig("pendulum", "Pendulum-v1", 0.01, 6, 30),
            # PPO's own has a ramp, which is as long as the training.
            "regularizer": L2C2Config(policy_distance="mean"),
            "algorithm": PPOConfig(
                num_envs=1,
                frames=50,
                epochs=2,
                hidden=(8,),
                clip_actions=True,
                log_scale=0.0,
                normalize_observations=True,
                normalize_rewards=True,
            ),
        },
    ],
    ids=("l2c2", "caps-hopper", "uniform-adam", "step", "rollouts"),
)
def test_a_continued_run_is_the_uninterrupted_one(tmp_path, settings):
    """Parameters, targets, thresholds, metrics and test episodes, to the last bit."""
    config = small(**settings)
    whole = Experiment(config, tmp_path / "whole")
    whole.train()
    first = Experiment(
        replace(config, task=replace(config.task, episodes=3)), tmp_path / "continued"
    )
    first.train()
    second = Experiment(config, tmp_path / "continued")
    assert len(second.metrics) == 3
    second.train()
    assert parameter_hash(second) == parameter_hash(whole)
    assert lines(tmp_path / "continued", False) == lines(tmp_path / "whole", False)
    assert second.test() == whole.test()


def test_a_copied_folder_continues_in_its_new_place(tmp_path):
    """As ``cp -r`` copies it, with its lock; the old folder stays as it is."""
    task = TaskConfig("pendulum", "Pendulum-v1", episodes=4, max_steps=30)
    old, new = tmp_path / "old", tmp_path / "new"
    whole = Experiment(small(task=task))
    whole.train()
    first = Experiment(small(task=replace(task, episodes=2)), old)  # Keeps the lock.
    first.train()
    before = contents(old)
    again = Experiment(small(task=task), shutil.copytree(old, new))
    assert len(again.metrics) == 2
    again.train()
    assert parameter_hash(again) == parameter_hash(whole)
    assert [row["episode"] for row in lines(new)] == ["1", "2", "3", "4"]
    assert contents(old) == before


@pytest.mark.parametrize("steps", range(8))
def test_a_finished_run_that_goes_on_is_unfinished(ended, monkeypatch, steps):
    """Killed after any of its first steps, it is not taken for the longer run, and goes on."""
    shorter, longer = small(), small(task=replace(SWINGUP, episodes=8))
    (ended / "video.mp4").touch()
    (ended / "export").mkdir()
    (ended / "export" / "policy.onnx").touch()
    left = iter(range(steps))

    def until_it_is_killed(changed):
        def change(*arguments, **options):
            if next(left, None) is None:
                raise KeyboardInterrupt
            return changed(*arguments, **options)

        return change

    with monkeypatch.context() as patched, contextlib.suppress(KeyboardInterrupt):
        write = until_it_is_killed(write_json)
        patched.setattr("torchrl_l2c2.experiment.run.folder.write_json", write)
        patched.setattr(Path, "unlink", until_it_is_killed(Path.unlink))
        Experiment(longer, ended).close()
    assert finished_run(ended, longer.to_dict()) is None
    assert (finished_run(ended, shorter.to_dict()) is None) == (steps > 0)
    saved = json.loads((ended / "config.json").read_text())
    ends = {"policy.pt", "video.mp4", "learning_curves.png", "policy.onnx"}
    of_the_longer = saved["task"]["episodes"] == 8
    assert not of_the_longer or not ends & {path.name for path in ended.rglob("*")}
    again = Experiment(longer, ended)
    assert len(again.train()) == 8


def finished(folder, **settings):
    run = Experiment(small(**settings), folder)
    run.train()
    run.finish(run.test())
    run.close()


def test_a_part_of_a_training_is_a_run_of_its_length(tmp_path):
    """In a notebook; the command then trains the rest, and tests of the part go with it."""
    run = Experiment(small(), tmp_path)
    run.train(2)
    run.finish(run.test())
    assert read_runs(tmp_path)[0].record.length == "2 episodes"
    assert finished_run(tmp_path, small().to_dict()) is None
    run.train()
    assert not (tmp_path / "evaluation.json").exists() and not (tmp_path / "policy.pt").exists()
    run.finish(run.test())
    assert read_runs(tmp_path)[0].record.length == "6 episodes"
    assert finished_run(tmp_path, small().to_dict()) is not None
    run.train(8)  # beyond the settings'
    run.finish(run.test())
    run.close()
    assert read_runs(tmp_path)[0].record.length == "8 episodes"


def test_what_changes_no_number_leaves_a_run_finished(ended):
    """And its test, also where something is made of such settings."""
    test = (ended / "evaluation.json").read_bytes()
    for settings in (
        {"test_episodes": 0},
        {"threads": 2},
        {"logger": GROUPS["logger"]["tensorboard"]},
        {"checkpoint_interval": 5.0},
        {"task": replace(small().task, solved_at=1e6)},
    ):
        assert finished_run(ended, small(**settings).to_dict()) is not None
        Experiment(small(**settings), ended).close()
        assert (ended / "evaluation.json").read_bytes() == test
        assert finished_run(ended, small().to_dict()) is not None


def test_a_setting_that_is_new_and_off_leaves_a_run_finished(ended):
    """A release that adds one has no test played again."""
    saved = json.loads((ended / "config.json").read_text())
    del saved["task"]["flatten"], saved["task"]["frames"], saved["regularizer"]["max_step"]
    (ended / "config.json").write_text(json.dumps(saved))
    assert finished_run(ended, small().to_dict()) is not None
    longer = small(task=replace(small().task, episodes=7))
    assert finished_run(ended, longer.to_dict()) is None


def test_what_only_training_reads_is_told_when_that_is_over(trained):
    """And not where the run goes on."""
    told = "evaluate_every=2 has no effect: training is over .* Choose another"
    with pytest.warns(UserWarning, match=told):
        Experiment(small(evaluate_every=2), trained).close()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Experiment(small(evaluate_every=2, task=replace(SWINGUP, episodes=8)), trained).close()


def test_a_finished_run_without_checkpoints_is_not_begun_anew(ended):
    """By another length, or another test; its results would be gone."""
    for path in list_checkpoints(ended):
        path.unlink()
    before = contents(ended)
    with pytest.raises(
        CheckpointError, match=r"has the results of a run, but no checkpoint.* to continue"
    ):
        Experiment(small(test_episodes=3), ended)
    assert contents(ended) == before


def test_a_test_of_other_length_replaces_the_old_one_when_it_has_ended(ended):
    """Interrupted, the old one is still there, and the same command plays the new one."""
    more = small(test_episodes=3)
    run = Experiment(more, ended)
    assert find_runs([ended]).runs[0].test_episodes == 1
    assert finished_run(ended, more.to_dict()) is None
    run.finish(run.test())
    run.close()
    assert finished_run(ended, more.to_dict()).test_episodes == 3
    assert finished_run(ended, small().to_dict()) is None


def test_changed_settings_are_refused_and_nothing_is_overwritten(trained):
    """The error names the setting with both values."""
    before = contents(trained)
    with pytest.raises(ValueError, match=r"regularizer.sigma=1.0, not 2.0: use the same"):
        Experiment(small(regularizer=L2C2Config(sigma=2.0)), trained)
    assert contents(trained) == before


def test_a_damaged_newest_checkpoint_gives_the_run_from_the_one_before(tmp_path):
    """With a warning; and the run ends with the same numbers all the same."""
    whole = Experiment(small(), tmp_path)
    whole.train()
    expected, rows = parameter_hash(whole), lines(tmp_path)
    newest, older = list_checkpoints(tmp_path)
    newest.write_bytes(newest.read_bytes()[:-1])
    with pytest.warns(UserWarning, match="checksum differs.*previous checkpoint is used"):
        again = Experiment(small(), tmp_path)
    assert len(again.metrics) == int(older.stem.split("_")[1])
    again.train()
    assert parameter_hash(again) == expected and lines(tmp_path) == rows


def test_a_policy_needs_its_folder_alone(tmp_path):
    """From a checkpoint before the run is finished."""
    experiment = Experiment(small(), tmp_path)
    experiment.train()
    policy, env, max_steps = load_policy(tmp_path)
    assert max_steps == 60
    td = env.reset()
    loc = experiment.agent.policy(td.clone())["loc"]
    assert policy(td)["loc"].equal(loc)


@pytest.mark.parametrize(
    "code, run, refused", [("run", "run", True), ("", "pack/run", True), ("own", "run", False)]
)
def test_a_run_brings_no_code(tmp_path, monkeypatch, code, run, refused):
    """Of its folder, or of a package around it; a task of one's own, from elsewhere, is made."""
    module = tmp_path / code / "pack" / "__init__.py"
    for folder in (tmp_path / run, module.parent):
        folder.mkdir(parents=True, exist_ok=True)
    module.write_text(f"open({str(tmp_path / 'executed')!r}, 'w')")
    settings = small().to_dict()
    settings["task"] |= {"name": "stray", "env_id": "pack:Stray-v0"}
    (tmp_path / run / "config.json").write_text(json.dumps(settings))
    monkeypatch.delitem(sys.modules, "pack", raising=False)
    monkeypatch.syspath_prepend(tmp_path / code)
    with pytest.raises(ValueError, match="comes with the run" if refused else "Gymnasium"):
        load_policy(tmp_path / run)
    assert (tmp_path / "executed").exists() is not refused
    # A notebook's own, which is imported and has no specification.
    monkeypatch.setitem(sys.modules, "pack", types.ModuleType("pack"))
    with pytest.raises(ValueError, match="Gymnasium"):
        load_policy(tmp_path / run)


def rewrite_newest(folder, change):
    """Changes the state in the newest checkpoint."""
    newest = list_checkpoints(folder)[0]
    change(state := load_checkpoint(newest))
    save_checkpoint(folder, int(newest.stem.split("_")[1]), state, keep=1)


def of_other_versions(folder, **changed):
    """Makes the newest checkpoint one that other versions wrote."""

    def change(state):
        state["versions"] = json.dumps(json.loads(state["versions"]) | changed)

    rewrite_newest(folder, change)


def test_an_unfinished_policy_is_told(trained):
    with pytest.warns(UserWarning, match="not finished: this is its policy after 6 episodes"):
        load_policy(trained)


def test_a_task_whose_actions_have_changed_is_not_continued(trained):
    """The task's code may change between two commands, which its name does not show."""
    rewrite_newest(trained, lambda state: state.update(actions="from [-9.0] to [9.0]"))
    told = r"actions were from \[-9.0\] to \[9.0\] in the checkpoint and are from \[-1.0\] to"
    with pytest.raises(OtherRunError, match=told):
        Experiment(small(), trained)
    rewrite_newest(trained, lambda state: state.pop("actions"))  # one of an earlier release
    assert len(Experiment(small(), trained).metrics) == 6


def test_other_versions_are_refused_unless_they_are_allowed(trained):
    """The error names what differs, with both versions; a package only there now matters not."""
    of_other_versions(trained, torch="1.0", box2d="2.3")
    told = f"made with torch 1.0, now {importlib.metadata.version('torch')}: the numbers may differ"
    with pytest.raises(OtherRunError, match=re.escape(told)):
        Experiment(small(), trained)
    with pytest.warns(UserWarning, match=re.escape(told)):
        again = Experiment(small(), trained, allow_other_versions=True)
    assert len(again.metrics) == 6


def test_what_another_experiment_went_on_with_is_not_written_over(tmp_path):
    """In one process, as of a notebook: the second of two objects would write episodes again."""
    first = Experiment(small(), tmp_path)
    first.train(2)
    second = Experiment(small(), tmp_path)
    first.train()
    first.finish(first.test())
    before = contents(tmp_path)
    with pytest.raises(OtherRunError, match=r"metrics\.csv has .* another Experiment has written"):
        second.train()
    assert contents(tmp_path) == before


def test_out_of_order_calls_are_refused_and_write_nothing(tmp_path):
    """Results without training would make the folder unusable; a closed run has no lock."""
    task = replace(SWINGUP, episodes=1)
    run = Experiment(small(task=task), tmp_path)
    result = run.test()
    before = contents(tmp_path)
    with pytest.raises(ValueError, match=r"no episode yet: call train\(\) before finish"):
        run.finish(result)
    assert contents(tmp_path) == before
    run.train()
    run.close()
    before = contents(tmp_path)
    for call in (run.train, run.save, partial(run.finish, result)):
        with pytest.raises(ValueError, match="this experiment was closed: create a new one"):
            call()
    assert contents(tmp_path) == before
    again = Experiment(small(task=task), tmp_path)
    shutil.rmtree(tmp_path)
    with pytest.raises(OtherRunError, match="which this run has written, is missing"):
        again.train(2)
    assert not tmp_path.exists()


def test_fewer_episodes_than_there_are_are_refused(trained):
    """Nothing is changed, and the run can be continued as it was or for longer."""
    before = contents(trained)
    with pytest.raises(OtherRunError, match=r"episodes=5 is fewer than the 6 .* already has"):
        Experiment(small(task=replace(SWINGUP, episodes=5)), trained)
    assert contents(trained) == before
    with pytest.raises(OtherRunError, match="episodes=5 is fewer than the 6"):
        Experiment(small(), trained).train(5)


def test_fewer_frames_than_there_are_are_refused(tmp_path):
    """What the last episode has beyond them may be asked for again or not."""
    task = replace(SWINGUP, frames=200)
    Experiment(small(task=task), tmp_path).train()
    config = (tmp_path / "config.json").read_bytes()
    with pytest.raises(OtherRunError, match=r"frames=199 is fewer than the 200 .* already has"):
        Experiment(small(task=replace(task, frames=199)), tmp_path)
    with pytest.raises(OtherRunError, match=r"episodes=1 is fewer than the \d+ that this run"):
        Experiment(small(task=replace(task, frames=None, episodes=1)), tmp_path)
    assert (tmp_path / "config.json").read_bytes() == config
    assert Experiment(small(task=task), tmp_path).metrics[-1]["frames"] > 200


def test_the_episodes_of_the_last_rollout_may_be_more_than_were_asked_for(tmp_path):
    """The same command again is the same run, whose length is what was asked for."""
    config = small(
        task=TaskConfig("pendulum", "Pendulum-v1", 0.01, 3, 20),
        algorithm=PPOConfig(num_envs=2, frames=80, epochs=1, hidden=(8,)),
    )
    first = Experiment(config, tmp_path)
    assert len(first.train()) == 4
    assert first.finish(first.test()).record.length == "3 episodes"
    again = Experiment(config, tmp_path)
    assert len(again.train()) == 4
    with pytest.raises(OtherRunError, match="episodes=2 is fewer than the 3"):
        Experiment(replace(config, task=replace(config.task, episodes=2)), tmp_path)


@pytest.mark.parametrize(
    ("setting", "told"),
    [
        ({"optimizer": AdamConfig(linear=True)}, "optimizer.linear=true"),
        ({"regularizer": L2C2Config(gain="ramp")}, "regularizer.gain=ramp"),
    ],
)
def test_what_followed_another_length_is_told(tmp_path, setting, told):
    """A longer run had it change more slowly; the same length is the same run."""
    config = small(task=replace(SWINGUP, episodes=1), **setting)
    Experiment(config, tmp_path).train()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Experiment(config, tmp_path).close()
    with pytest.warns(UserWarning, match=f"{told} .*schedule of 1 episodes .* of 6 episodes would"):
        Experiment(replace(config, task=SWINGUP), tmp_path).close()


def test_what_changes_no_number_may_change(trained):
    """Where metrics go, which policies are tested and how often it is saved."""
    other = small(
        logger=GROUPS["logger"]["tensorboard"], late_share=0.5, test_episodes=3, checkpoint_keep=5
    )
    assert len(Experiment(other, trained).metrics) == 6


def test_a_setting_that_a_checkpoint_does_not_know_is_named(tmp_path):
    """One of an earlier release, before there was such a setting."""
    saved = small().to_dict()
    del saved["algorithm"]["kappa"]
    with pytest.raises(OtherRunError, match=r"made with algorithm.kappa=none .*, not 0.5:"):
        check_same_settings(saved, small().to_dict())


def test_a_setting_that_changes_nothing_may_be_new():
    """A checkpoint of before is continued where the run goes on as it was; not otherwise."""
    saved = small().to_dict()
    del saved["regularizer"]["policy_distance"]
    check_same_settings(saved, small().to_dict())
    with pytest.raises(OtherRunError, match=r"policy_distance=none \(a newer setting\), not mean"):
        now = small(regularizer=L2C2Config(policy_distance="mean"))
        check_same_settings(saved, now.to_dict())


def test_all_changed_settings_are_named():
    saved = small().to_dict()
    saved["optimizer"]["lr"], saved["algorithm"]["gamma"] = 0.5, 0.25
    with pytest.raises(
        OtherRunError, match=r"made with algorithm.gamma=0.25, .*; optimizer.lr=0.5"
    ):
        check_same_settings(saved, small().to_dict())


def test_another_choice_is_named_and_not_what_it_brings():
    """Its settings are others, too, and come first in the alphabet."""
    saved = small(regularizer=NoRegularizerConfig()).to_dict()
    with pytest.raises(OtherRunError, match=r"made with regularizer=none, not l2c2: use the same"):
        check_same_settings(saved, small().to_dict())


def test_metrics_that_another_program_has_saved_are_refused(tmp_path):
    """Before anything is trained; with the lines' ends of the program they would be cut in two."""
    config = small(task=replace(SWINGUP, episodes=3))
    experiment = Experiment(config, tmp_path)
    experiment.train(1)
    experiment.close()
    metrics = tmp_path / "metrics.csv"
    content = metrics.read_bytes()
    number = re.search(rb"[0-9.]{6,}", content)
    cut = content[: number.start()] + b"x" + content[number.start() + 1 :]
    for changed in (content.replace(b"\n", b"\r\n"), content[:-1], cut):
        metrics.write_bytes(changed)
        with pytest.raises(ValueError, match="is not as it was at the checkpoint"):
            Experiment(config, tmp_path)
    metrics.write_bytes(content)
    newest = list_checkpoints(tmp_path)[0]
    state = load_checkpoint(newest)
    del state["metrics_log"]["sha256"]  # as in an older checkpoint
    save_checkpoint(tmp_path, int(newest.stem.split("_")[1]), state, keep=1)
    assert len(Experiment(config, tmp_path).train()) == 3


@pytest.mark.parametrize("file", ["checkpoint_00000002.pt", "metrics.csv", "train.log"])
def test_a_full_disk_names_the_file_and_the_last_good_checkpoint(tmp_path, monkeypatch, file):
    """And the run continues from there when there is room again."""
    config = small(task=replace(SWINGUP, episodes=3))
    experiment = Experiment(config, tmp_path)
    experiment.train(1)
    full = OSError(28, "No space left on device")

    def no_room(path, *arguments, **options):
        if Path(path).name.strip(".").startswith(file):
            raise full
        return open(path, *arguments, **options)

    monkeypatch.setattr("torchrl_l2c2.experiment.run.files.open", no_room, raising=False)
    message = rf"No space left.*{file}'\. Last good checkpoint: .*checkpoint_00000001.pt"
    with pytest.raises(OSError, match=message):
        experiment.train()
    experiment.close()
    monkeypatch.undo()
    assert len(Experiment(config, tmp_path).train()) == 3


def test_a_warning_is_a_line_in_the_log_too(tmp_path, capsys):
    """And not Python's, with a line of its source; once, though filters change between."""
    with warnings_as_lines(partial(show_and_log, tmp_path)):
        for _ in range(2):
            warnings.warn("hardly regularized", stacklevel=1)
            warnings.simplefilter("always")
    assert capsys.readouterr().err == "warning: hardly regularized\n"
    assert (tmp_path / "train.log").read_text().endswith(" warning: hardly regularized\n")


def test_an_error_that_there_is_no_room_to_log_is_told(tmp_path):
    """And not that of the log in its place."""
    (tmp_path / "train.log").mkdir()
    with pytest.raises(ValueError, match="its own"), _log_errors(tmp_path):
        raise ValueError("its own")


def start(folder, episodes, *extra, log=None):
    settings = (
        "compile=false", f"task.episodes={episodes}", "task.max_steps=50", "algorithm.updates=5",
        "test_episodes=1", "checkpoint_interval=0", f"hydra.run.dir={folder}", *extra,
    )  # fmt: skip
    output = messages(folder.with_name(log or folder.name))
    output.write_text("")
    return start_train(*settings, output=output, cwd=folder.parent)


def messages(folder):
    return folder.with_suffix(".log")


def final(folder):
    state = load_checkpoint(list_checkpoints(folder)[0])
    digest = hashlib.sha256()
    for name, tensor in sorted(state["loss"].items()):
        if hasattr(tensor, "numpy"):
            digest.update(name.encode() + tensor.numpy().tobytes())
    return digest.hexdigest()


def wait_for(condition, process, pause=0.01):
    ends = time.monotonic() + 120
    while not condition():
        assert process.poll() is None, f"the process ended with {process.returncode}"
        assert time.monotonic() < ends, "nothing happened"
        if pause:
            time.sleep(pause)


@pytest.mark.parametrize(
    "kills",
    [1, pytest.param(20, marks=pytest.mark.slow)],
)
def test_killed_processes_end_with_the_numbers_of_the_one_that_was_not(tmp_path, kills):
    """SIGKILL between and within episodes, and while a checkpoint is being written."""
    episodes = 8 * (kills + 1)
    undisturbed = start(tmp_path / "undisturbed", episodes)
    assert undisturbed.wait(600) == 0, messages(tmp_path / "undisturbed").read_text()
    folder = tmp_path / "killed"
    for kill in range(kills):
        process = start(folder, episodes)
        known = len(lines(folder)) if (folder / "metrics.csv").exists() else 0
        wait_for(
            lambda known=known: (
                (folder / "metrics.csv").exists() and len(lines(folder)) >= known + 2
            ),
            process,
        )
        if kill == kills - 1:
            # A write takes a millisecond or two: no pause, or it is missed.
            wait_for(lambda: any(folder.glob(".checkpoint_*.partial")), process, pause=0)
        else:
            time.sleep(0.03 * kill)
        process.send_signal(signal.SIGKILL)
        process.wait()
        assert all(None not in row.values() for row in lines(folder)), "half a line"
    last = start(folder, episodes)
    assert last.wait(600) == 0, messages(folder).read_text()
    assert final(folder) == final(tmp_path / "undisturbed")
    assert lines(folder) == lines(tmp_path / "undisturbed")


@pytest.mark.parametrize(
    "number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)]
)
def test_a_second_process_is_refused_and_a_signal_saves_the_first(tmp_path, number):
    """The folder stays as it is; the same command goes on after the signal."""
    folder = tmp_path / "run"
    first = start(folder, 2000, "checkpoint_interval=3600")
    wait_for(lambda: (folder / "metrics.csv").exists() and len(lines(folder)) >= 2, first)
    config = (folder / "config.json").stat().st_mtime_ns
    second = start(folder, 2000, "checkpoint_interval=3600", log="second")
    assert second.wait(60) == 1
    refusal = messages(tmp_path / "second").read_text()
    assert f"in use by process {first.pid} on" in refusal and "Traceback" not in refusal
    assert (folder / "config.json").stat().st_mtime_ns == config and first.poll() is None
    first.send_signal(number)
    assert first.wait(30) == 128 + number
    errors = messages(folder).read_text()
    assert f"{number.name} ended the training" in errors and "Traceback" not in errors
    episodes = len(lines(folder))
    again = start(folder, episodes + 1)
    assert again.wait(120) == 0, messages(folder).read_text()
    assert len(lines(folder)) == episodes + 1
