"""Runs of the experiment, as a user starts them: short, but of every task and regularizer."""

import csv
import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import gymnasium
import numpy as np
import processes
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import GymEnv, RenameTransform, SerialEnv, TransformedEnv

from torchrl_l2c2 import make_actor
from torchrl_l2c2.experiment import (
    AdamConfig,
    AdaTermConfig,
    CAPSConfig,
    Experiment,
    ExperimentConfig,
    L2C2Config,
    NoRegularizerConfig,
    PPOConfig,
    PPORPEConfig,
    RolloutReplayConfig,
    SACConfig,
    TaskConfig,
    TD3Config,
    UniformReplayConfig,
    make_env,
)
from torchrl_l2c2.experiment.analysis.reports import read_runs
from torchrl_l2c2.experiment.envs.frames import check_finite
from torchrl_l2c2.experiment.errors import SimulatorError
from torchrl_l2c2.experiment.run.evaluation import LateTests, evaluate_policy

ROOT = Path(__file__).parent.parent
TASKS = {
    "swingup": "InvertedPendulumSwingupBulletEnv-v0",
    "reacher": "ReacherBulletEnv-v0",
    "hopper": "HopperBulletEnv-v0",
    "ant": "AntBulletEnv-v0",
}
PENDULUM = TaskConfig("pendulum", "Pendulum-v1", noise_scale=0.01, episodes=2, max_steps=40)
FEW_UPDATES = PPORPEConfig(replay_ratio=2.0)


def small(**settings):
    usual = {"task": PENDULUM, "algorithm": FEW_UPDATES, "compile": False, "test_episodes": 2}
    return ExperimentConfig(**{**usual, **settings})


def known(row):
    """A row of metrics without the clock's, and without what was not measured."""
    return {k: v for k, v in row.items() if k != "frames_per_second" and not math.isnan(v)}


@pytest.mark.parametrize(
    ("task", "regularizer"),
    [
        *((task, L2C2Config()) for task in TASKS),
        ("swingup", NoRegularizerConfig()),
        ("swingup", CAPSConfig()),
    ],
)
def test_200_steps_of_every_task_and_with_every_method(task, regularizer):
    """Collects, replays, updates and logs finite numbers, the regularizer's terms among them."""
    # Untrained, these fall after some twenty steps.
    episodes = {"hopper": 20, "ant": 8}.get(task, 2)
    config = TaskConfig(
        task, f"pybullet_envs_gymnasium:{TASKS[task]}", episodes=episodes, max_steps=100
    )
    experiment = Experiment(small(task=config, regularizer=regularizer, test_episodes=1))
    metrics = experiment.train()
    assert experiment.player.frames >= 200
    assert experiment.learner.updates > 0
    terms = {key for key in metrics[-1] if key.startswith("loss_")}
    added = {
        "none": set(),
        "caps": {"loss_caps_temporal", "loss_caps_spatial"},
        "l2c2": {"loss_l2c2_actor", "loss_l2c2_critic"},
    }[regularizer.name]
    assert terms == {"loss_actor", "loss_critic"} | added
    assert len(experiment.test().returns) == 1


def test_the_same_seed_gives_the_same_numbers_and_another_seed_others():
    """Everything random hangs on the seed."""

    def numbers(seed):
        return known(Experiment(small(seed=seed)).train()[-1])

    assert numbers(0) == numbers(0)
    assert numbers(0) != numbers(1)


@pytest.mark.parametrize(
    "settings",
    [
        {"replay": UniformReplayConfig(batch_size=32)},
        {"optimizer": AdamConfig()},
        {"algorithm": replace(FEW_UPDATES, schedule="step")},
        {"algorithm": replace(FEW_UPDATES, acting_policy="online", baseline="target")},
        {"algorithm": replace(FEW_UPDATES, importance="mean")},
        {"algorithm": replace(FEW_UPDATES, reduction="mean")},
        {"algorithm": replace(FEW_UPDATES, time_limit="terminated", squash="sigmoid")},
        {"algorithm": replace(FEW_UPDATES, squash="none", threshold="ema")},
        {"algorithm": replace(FEW_UPDATES, critic_weighting="ratio")},
        {"algorithm": replace(FEW_UPDATES, reward_scale=1.0, hidden=(8,), num_heads=1)},
        {"algorithm": PPORPEConfig(updates=3)},
        {"task": replace(PENDULUM, noise_scale=0.0)},
    ],
    ids=str,
)
def test_every_alternative_changes_the_run(settings):
    """No option is read nowhere: each gives other parameters than the defaults do."""
    first, second = parameters_of_defaults(), parameters_of(small(**settings))
    assert second.isfinite().all()
    assert first.shape != second.shape or not torch.equal(first, second)


def parameters_of(config):
    experiment = Experiment(config)
    experiment.train()
    return torch.cat([p.detach().flatten() for p in experiment.agent.loss.parameters()])


@cache
def parameters_of_defaults():
    return parameters_of(small())


def test_a_sum_over_the_batch_is_a_smaller_eps():
    """To AdaTerm: its steps know no other scale of a gradient. The regularizer is summed, too."""
    # So strong that its gain shows, also where the weights of prioritized replay differ.
    strong = L2C2Config(lambda_min=10.0, lambda_max=1000.0)

    def learn(reduction, eps):
        chosen = {"algorithm": PPORPEConfig(reduction=reduction, updates=3, hidden=(8,))}
        optimizer = AdaTermConfig(eps=eps)
        experiment = Experiment(small(**chosen, regularizer=strong, optimizer=optimizer))
        experiment.train()
        return torch.cat([p.detach().flatten() for p in experiment.agent.loss.parameters()])

    summed, averaged = learn("sum", 1e-3), learn("mean", 1e-3)
    torch.testing.assert_close(summed, learn("mean", 1e-3 / 32), rtol=0, atol=1e-6)
    assert (summed - averaged).abs().max() > 1e-4


@pytest.mark.parametrize("time_limit", ["truncated", "terminated"])
def test_the_value_at_a_time_limit(time_limit):
    """Of rewards of 0 and a value of 5 everywhere: gamma times 5, or 0 as at a terminal state."""
    loss = Experiment(small(algorithm=PPORPEConfig(time_limit=time_limit))).agent.loss
    batch = TensorDict(
        {
            "observation": torch.zeros(2, 3),
            "action": torch.zeros(2, 1),
            "action_log_prob": torch.zeros(2),
            "next": {
                "observation": torch.zeros(2, 3),
                "reward": torch.zeros(2, 1),
                "done": torch.tensor([[True], [False]]),
                "terminated": torch.zeros(2, 1, dtype=torch.bool),
            },
        },
        [2],
    )
    for parameters in (loss.critic_network_params, loss.target_critic_network_params):
        parameters.apply_(lambda p: p.data.zero_())
        parameters["module", "body", "6", "bias"].data.fill_(5.0)
    loss(batch)
    at_limit = 5.0 if time_limit == "terminated" else 0.05
    torch.testing.assert_close(batch["td_error"], torch.tensor([at_limit, 0.05]))


@pytest.mark.parametrize("scale", [0.1, 1.0, 2.5])
def test_the_policy_begins_with_the_initial_scale(scale):
    """Where the network's output is 0."""
    policy = Experiment(small(algorithm=PPORPEConfig(initial_scale=scale))).agent.policy
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.zero_()
        played = policy(TensorDict({"observation": torch.ones(4, 3)}, [4]))
    assert played["loc"].abs().max() == 0
    torch.testing.assert_close(played["scale"], torch.full((4, 1), scale))


def test_updates_follow_the_schedule():
    """One pass over the buffer after each episode, or so many after each step."""
    episode = Experiment(small(algorithm=PPORPEConfig(replay_ratio=None)))
    episode.train()
    assert episode.learner.updates == 40 // 32 + 80 // 32
    step = Experiment(small(algorithm=PPORPEConfig(schedule="step", updates=2)))
    step.train(1)
    # From the step on that fills the first batch of 32.
    assert step.learner.updates == 2 * (40 - 31)


def test_the_replay_ratio_is_how_often_a_transition_is_drawn():
    """updates = ratio * frames / batch after each episode; what is left over comes later."""
    ratio = Experiment(small(algorithm=PPORPEConfig(replay_ratio=2.0)))
    # 40 frames an episode, batches of 32: 2.5 updates each.
    assert [row["updates"] for row in ratio.train()] == [2, 5]
    with pytest.raises(ValueError, match="replay_ratio and updates both set"):
        PPORPEConfig(replay_ratio=2.0, updates=3)
    # The default ratio gives way to a number.
    assert PPORPEConfig(updates=3).updates_after(40, 80, 80, 32) == 3


def test_late_policies_play_test_episodes_that_change_nothing_else():
    """The last part of training has figures of the mean policy; without them all else is equal."""
    task = replace(PENDULUM, episodes=4)
    rows, others = (Experiment(small(task=task, late_share=share)).train() for share in (0.5, 0.0))
    assert [math.isnan(row["test_return"]) for row in rows] == [True, True, False, False]
    assert rows[2]["test_return"] != rows[3]["test_return"]
    assert rows[3]["test_action_variation"] > 0.0
    for row, other in zip(rows, others, strict=True):
        measured = {key: value for key, value in row.items() if not key.startswith("test_")}
        assert known(measured) == known(other)


def test_a_test_may_act_with_samples_and_measures_the_mean_all_the_same():
    """Other returns than the mean's; the variation is not that of the noise."""
    experiment = Experiment(small())
    mean, sampled = (experiment.test(3, sampled=s) for s in (False, True))
    assert all(a != b for a, b in zip(mean.returns, sampled.returns, strict=True))
    # An untrained policy's samples jump by its scale of about 1, twice over on Pendulum.
    assert max(sampled.action_variations) < 0.3


def test_the_policys_scale_is_logged():
    """L2C2's distance is relative to it; a deterministic policy has none."""
    row = Experiment(small()).train()[0]
    assert 0.5 < row["policy_scale"] < 2.0  # 1 where the network's output is 0
    td3 = small(algorithm=TD3Config(hidden=(8,)))
    assert math.isnan(Experiment(td3).train()[0]["policy_scale"])


def test_the_acting_policy_is_the_current_target():
    """It shares the target's parameters, so it follows every update."""
    experiment = Experiment(small())
    before = [p.clone() for p in experiment.agent.policy.parameters()]
    experiment.train()
    target = experiment.agent.loss.target_actor_network_params
    observation = torch.randn(4, 3)
    with target.to_module(experiment.agent.loss.actor_network):
        expected = experiment.agent.loss.actor_network.module[0](observation)
    torch.testing.assert_close(experiment.agent.policy.module[0](observation), expected)
    after = list(experiment.agent.policy.parameters())
    assert all(not torch.equal(a, b) for a, b in zip(before, after, strict=True))


def test_nan_from_the_environment_stops_the_run_with_key_and_frame():
    """Nothing is learned from it, and the message says where it began."""
    env = make_env(PENDULUM, seed=0)
    batch = env.rollout(10, make_actor(3, env.action_spec))
    batch["next", "reward"][4] = float("nan")
    with pytest.raises(FloatingPointError, match=r"'next', 'reward'.*frame 105"):
        check_finite(batch.detach(), first_frame=100)


class Faulty(gymnasium.Env):
    """Its third reward is no number."""

    observation_space = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.frame = 0
        return np.zeros(2, np.float32), {}

    def step(self, action):
        self.frame += 1
        return np.zeros(2, np.float32), math.nan if self.frame == 3 else 0.0, False, False, {}


gymnasium.register("Faulty-v0", entry_point=Faulty)


def test_nan_in_a_test_episode_gives_no_result():
    """Neither at the end nor late in training: a mean with it would be none."""
    task = TaskConfig("faulty", "Faulty-v0", episodes=1, max_steps=5)
    env = make_env(task, seed=0)
    policy = make_actor(2, env.action_spec)
    with pytest.raises(FloatingPointError, match=r"'next', 'reward'.*frame 3"):
        evaluate_policy(policy, env, 2, max_steps=5)
    with pytest.raises(FloatingPointError, match=r"'next', 'reward'.*frame 3"):
        LateTests(task, 0, policy, compile_policy=False).play(1)


def test_policies_are_played_where_they_read_one_observation_of_one_environment():
    """Of any name; a batch's measures would be along another dimension."""
    env = GymEnv("Pendulum-v1", max_episode_steps=20)
    actor = make_actor(3, env.action_spec, in_keys=["policy"])
    named = TransformedEnv(env, RenameTransform(["observation"], ["policy"]))
    result = evaluate_policy(actor, named, 2, sampled=True)
    assert result.lengths == [20, 20] and all(map(math.isfinite, result.summary().values()))
    with pytest.raises(ValueError, match=r"policy reads 'policy', and the environment has \['obs"):
        evaluate_policy(actor, env, 2)
    for number in (1, 2):
        with pytest.raises(
            ValueError, match=rf"a single environment, got a batch of \({number},\)"
        ):
            evaluate_policy(actor, SerialEnv(number, lambda: GymEnv("Pendulum-v1")), 2)
    with pytest.raises(TypeError, match="policy must be an actor of TorchRL"):
        evaluate_policy(torch.nn.Linear(3, 1), env, 2)


def broken_after(experiment, frames, outcome):
    """Lets the simulator give (or raise) something else once so many frames were played."""
    original, left = experiment.player.collector._simulation._gymnasium.step, [frames]

    def step(action):
        left[0] -= 1
        if left[0] > 0:
            return original(action)
        if isinstance(outcome, BaseException):
            raise outcome
        observation, _, *ends = original(action)
        return observation, outcome, *ends

    experiment.player.collector._simulation._gymnasium.step = step


@pytest.mark.parametrize(
    ("outcome", "error", "message"),
    [
        (float("nan"), FloatingPointError, r"'reward'\) is not finite at frame 60: \[nan\]"),
        (
            RuntimeError("physics gone"),
            SimulatorError,
            "failed in the episode after frame 40: .* physics gone",
        ),
        (SystemExit(4), SimulatorError, r"failed in the episode after frame 40: SystemExit: 4\."),
    ],
)
def test_a_broken_simulator_stops_the_run_and_leaves_a_checkpoint(
    tmp_path, outcome, error, message
):
    """The error says where it began, and the checkpoint of the episode before is usable."""
    config = small(checkpoint_interval=0.0)
    experiment = Experiment(config, tmp_path)
    broken_after(experiment, 60, outcome)
    with pytest.raises(error, match=message) as raised:
        experiment.train()
    assert "Last good checkpoint: " in str(raised.value) and "00000001.pt" in str(raised.value)
    again = Experiment(config, tmp_path)
    assert len(again.metrics) == 1 and len(again.train()) == 2


def test_a_loss_that_is_not_finite_stops_the_run_with_its_name(monkeypatch):
    """The term, the update and the frame."""
    experiment = Experiment(small())
    original = experiment.learner.update

    def update(with_policy):
        values = original(with_policy)
        values[1] = float("inf")
        return values

    experiment.learner.update = update
    with pytest.raises(FloatingPointError, match=r"loss_critic is inf at update 1 \(frame 40\)"):
        experiment.train()


def test_a_longer_run_begins_as_a_shorter_one():
    """Also through the last tenth of the shorter one, where its policies are tested."""
    runs = [
        Experiment(small(task=replace(PENDULUM, episodes=episodes), late_share=0.5)).train()
        for episodes in (4, 6)
    ]
    tests = ("test_return", "test_action_variation")
    short, long = (
        [known({**row, **dict.fromkeys(tests, math.nan)}) for row in run] for run in runs
    )
    assert long[:4] == short and "test_return" in known(runs[0][-1])


def test_a_training_in_parts_is_the_one_in_one_go():
    """Also beside tests; the learning rate falls over all of it, whose last part has late tests."""
    task, adam = replace(PENDULUM, episodes=6), AdamConfig(linear=True)
    settings = small(task=task, optimizer=adam, late_share=0.5)
    whole, parts = Experiment(settings), Experiment(settings)
    for episodes in (2, 4, None):
        parts.train(episodes)
        parts.test(1, sampled=True)
    assert [*map(known, parts.metrics)] == [*map(known, whole.train())]
    rates = [each.agent.optimizer.param_groups[0]["lr"] for each in (whole, parts)]
    assert rates == [0.0, 0.0]


ALGORITHMS = {
    "sac": SACConfig(random_frames=60),
    "td3": TD3Config(random_frames=60),
    "ppo": PPOConfig(frames=60, epochs=2),
}


@pytest.mark.parametrize("regularizer", [NoRegularizerConfig(), L2C2Config()])
@pytest.mark.parametrize("name", ALGORITHMS)
def test_every_algorithm_learns_from_its_batches(name, regularizer):
    """Updates happen, every parameter group moves, and the regularizer's terms are there."""
    batches = (
        RolloutReplayConfig(batch_size=32) if name == "ppo" else UniformReplayConfig(batch_size=32)
    )
    config = small(algorithm=ALGORITHMS[name], replay=batches, regularizer=regularizer)
    experiment = Experiment(config)
    before = [p.clone() for p in experiment.agent.loss.parameters()]
    metrics = experiment.train()
    after = list(experiment.agent.loss.parameters())
    assert experiment.learner.updates > 0
    assert all(p.isfinite().all() for p in after)
    assert all(not torch.equal(a, b) for a, b in zip(before, after, strict=True))
    added = {key for key in metrics[-1] if key.startswith("loss_l2c2")}
    values = {"sac": "qvalue", "td3": "qvalue", "ppo": "critic"}[name]
    expected = {f"loss_l2c2_{values}", "loss_l2c2_actor"}
    assert added == (expected if regularizer.name == "l2c2" else set())
    assert len(experiment.test().returns) == 2
    with pytest.raises(ValueError, match="episodes must be at least 1, got 0"):
        experiment.test(0)


@pytest.mark.parametrize("regularizer", [NoRegularizerConfig(), L2C2Config()])
def test_what_sac_keeps_is_there_before_it_is_compiled(regularizer):
    """Its target entropy, which it otherwise makes in its first, compiled, call, and loses."""
    config = small(
        algorithm=ALGORITHMS["sac"], replay=UniformReplayConfig(), regularizer=regularizer
    )
    # Not state_dict, which would make it.
    assert Experiment(config).agent.loss._buffers["_target_entropy"] == -1.0


def run_train(*overrides, folder, check=True):
    settings = (*overrides, f"outputs={folder}", "compile=false")
    return processes.run_train(*settings, cwd=folder, check=check)


PENDULUM_OVERRIDES = (
    "task=gymnasium",
    "task.env_id=Pendulum-v1",
    "task.episodes=3",
    "task.max_steps=50",
    "test_episodes=2",
)


SHORTER = ("algorithm.replay_ratio=1", "test_episodes=1")


def test_a_run_from_the_command_line_leaves_everything_behind(tmp_path):
    """Configuration, versions, metrics, policy, test episodes, picture; the result is printed."""
    finished = run_train(*PENDULUM_OVERRIDES, "logger=tensorboard", folder=tmp_path)
    assert finished.stdout.count("2 test episodes, seed 0") == 2  # mean and sampled actions
    (run,) = read_runs(tmp_path)
    assert "(the preset for ppo_rpe: results/paper.md" in (run.folder / "train.log").read_text()
    assert run.regularizer == "l2c2" and len(run.evaluation["episodes"]["returns"]) == 2
    with open(run.folder / "metrics.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["frames"] for row in rows] == ["50", "100", "150"]
    assert {"return", "action_variation", "loss_l2c2_actor", "l2c2_gain"} <= set(rows[0])
    assert run.folder.relative_to(tmp_path).as_posix() == (
        "Pendulum-v1/ppo_rpe/l2c2/max_steps-50_compile-false/seed_0"
    )
    # The field's measures, of the means and of the samples that were played.
    assert 0 < run.evaluation["summary"]["roughness_mean"] < 0.5
    assert len(run.evaluation["sampled"]["episodes"]["measures"]["sampled_sm_asap"]) == 2
    assert "torchrl" in json.loads((run.folder / "versions.json").read_text())
    config = json.loads((run.folder / "config.json").read_text())
    assert ExperimentConfig.from_dict(config).task.env_id == "Pendulum-v1"
    assert (run.folder / "learning_curves.png").read_bytes().startswith(b"\x89PNG")
    assert list((run.folder / "tensorboard").glob("events*"))
    policy = torch.load(run.folder / "policy.pt", weights_only=True)
    make_actor(3, make_env(PENDULUM, 0).action_spec).load_state_dict(policy)
    (run.folder / "learning_curves.png").unlink()
    again = run_train(*PENDULUM_OVERRIDES, "evaluate_every=1", folder=tmp_path)
    assert again.stdout.count("2 test episodes, seed 0") == 2
    assert "finished before: these are its results" in again.stdout
    assert "finished before" not in finished.stdout
    assert "mean of the last 3 episodes: return " in finished.stderr
    assert "evaluate_every=1 has no effect: training is over" in again.stderr
    assert (run.folder / "learning_curves.png").exists()
    # Without a length, the default would train it on and remove its results.
    lengthless = [each for each in PENDULUM_OVERRIDES if not each.startswith("task.episodes")]
    refused = run_train(*lengthless, folder=tmp_path, check=False)
    assert refused.returncode == 1 and "Traceback" not in refused.stderr
    assert "this run is finished, with task.episodes=3. Without a length" in refused.stderr
    assert "task.episodes=350 to train on" in refused.stderr
    assert (run.folder / "policy.pt").exists() and (run.folder / "evaluation.json").exists()
    longer = run_train(*lengthless, "task.episodes=4", "test_episodes=0", folder=tmp_path)
    said = "removed the results of the earlier policy: evaluation.json, policy.pt"
    assert said in longer.stdout + longer.stderr
    assert said in (run.folder / "train.log").read_text()


def test_without_a_terminal_there_are_a_few_plain_lines(tmp_path):
    """At each tenth, each once; train.log has them as well, and nothing of a refused command."""
    overrides = [*PENDULUM_OVERRIDES[:2], "task.episodes=40", "task.max_steps=5"]
    overrides += ["algorithm.updates=1", "test_episodes=0"]
    done = run_train(*overrides, folder=tmp_path)
    shown = [line for line in done.stderr.splitlines() if line.startswith("episode ")]
    assert [line.split(":")[0] for line in shown] == [f"episode {n} of 40" for n in range(4, 41, 4)]
    assert "\r" not in done.stderr
    (log,) = tmp_path.rglob("train.log")
    for line in shown:
        assert line in log.read_text()
    # Without test episodes there is a policy, and no result.
    assert (log.parent / "policy.pt").exists() and not (log.parent / "evaluation.json").exists()
    written = log.read_bytes()
    failed = run_train(*overrides, "task.episodes=20", folder=tmp_path, check=False)
    assert failed.returncode == 1 and "episodes=20 is fewer than the 40" in failed.stderr
    assert log.read_bytes() == written


BROKEN_TASK = """
import gymnasium
from gymnasium.envs.classic_control.pendulum import PendulumEnv
class Broken(PendulumEnv):
    steps = 0
    def step(self, action):
        self.steps += 1
        if self.steps == 60:
            self.lower_the_boom()
        return super().step(action)
    def lower_the_boom(self):
        raise KeyError("boom")
gymnasium.register("Broken-v0", entry_point=Broken)
"""


def test_an_error_of_the_users_own_task_is_shown_with_its_lines(tmp_path, monkeypatch):
    """The traceback, then one line."""
    (tmp_path / "broken_task.py").write_text(BROKEN_TASK)
    monkeypatch.setenv("PYTHONPATH", str(ROOT))  # The task lies in the current folder.
    settings = ["task.env_id=broken_task:Broken-v0", "task.episodes=4"]
    done = run_train(*PENDULUM_OVERRIDES, *settings, folder=tmp_path, check=False)
    assert done.returncode == 1
    assert 'broken_task.py", line 9, in step' in done.stderr and "lower_the_boom" in done.stderr
    assert "KeyError: 'boom'" in done.stderr
    told = done.stderr.splitlines()[-1]
    assert told.startswith("error: broken_task:Broken-v0 failed in the ") and "'boom'" in told


def test_a_sweep_gives_one_table(tmp_path):
    """Methods and seeds in their order; -m may stand anywhere."""
    overrides = (*SHORTER, "regularizer=none,l2c2", "seed=0,1", "hydra/launcher=basic")
    done = run_train(*PENDULUM_OVERRIDES, "-m", *overrides, folder=tmp_path)
    runs = read_runs(tmp_path)
    assert [(run.regularizer, run.seed) for run in runs] == [
        ("none", 0),
        ("none", 1),
        ("l2c2", 0),
        ("l2c2", 1),
    ]
    # Each says where the sweep stands, and how long the rest takes by those before.
    assert "run 1 of 4: Pendulum-v1, ppo_rpe, none, seed 0" in done.stdout
    assert "run 4 of 4, about 1 min left: Pendulum-v1, ppo_rpe, l2c2, seed 1" in done.stdout
    assert "run 4 of 4; episode 3 of 3" in done.stderr
    # At the end of the sweep, of its own runs.
    _, table = done.stdout.split("**Last policy, mean actions**")
    assert table.count("| baseline | 2 |") == table.count("| L2C2 | 2 |") == 1


def test_in_a_sweep_a_failed_job_is_told_and_the_others_go_on(tmp_path):
    """And the same command again does not repeat what is finished."""
    overrides = ("-m", *PENDULUM_OVERRIDES, *SHORTER, "hydra/launcher=basic")
    # Each value is right, and so the sweep begins; the last pair of them is wrong.
    overrides += ("replay.capacity=300,100", "replay.batch_size=8,200")
    failed = run_train(*overrides, folder=tmp_path, check=False)
    assert failed.returncode == 1
    assert "replay.capacity must be at least the batch_size (200), got 100" in failed.stderr
    written = {run.folder: written_at(run.folder) for run in read_runs(tmp_path)}
    assert len(written) == 3
    again = run_train(*overrides, folder=tmp_path, check=False)
    # The failed job is tried again.
    assert "replay.capacity must be at least the batch_size (200), got 100" in again.stderr
    assert {folder: written_at(folder) for folder in written} == written


def written_at(folder):
    return (folder / "evaluation.json").stat().st_mtime_ns


def test_a_wrong_setting_ends_with_one_clear_line(tmp_path):
    """No traceback: what was given and what is allowed; and nothing is written half."""
    wrong = ("task=gymnasium", "task.env_id=Nowhere-v0")  # of a sweep: test_sweep
    failed = run_train(*wrong, folder=tmp_path, check=False)
    assert failed.returncode == 1
    assert "Traceback" not in failed.stderr
    assert failed.stderr.strip().splitlines()[-1].startswith("error: ")
    assert "Nowhere-v0' is not a task that Gymnasium" in failed.stderr
    assert not list(tmp_path.iterdir())


def test_discrete_actions_are_refused_when_the_run_is_made():
    """Before anything is computed."""
    with pytest.raises(ValueError, match="actions are a Discrete; they must be one vector of flo"):
        Experiment(small(task=TaskConfig("cartpole", "CartPole-v1")))


def test_an_unwritable_folder_is_named(tmp_path):
    """Found before anything is computed."""
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(OSError, match="cannot be written to"):
        Experiment(small(), folder=tmp_path / "file")


def test_a_config_of_another_type_is_refused(tmp_path):
    """With one that would do."""
    with pytest.raises(TypeError, match=r"config must be an ExperimentConfig, got a dict: Exper"):
        Experiment({"seed": 1}, tmp_path)
