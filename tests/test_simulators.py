"""Every algorithm on tasks of every simulator: 300 frames each."""

import importlib.util

import pytest

from torchrl_l2c2.experiment import (
    AdamConfig,
    Experiment,
    ExperimentConfig,
    PPOConfig,
    PPORPEConfig,
    RolloutReplayConfig,
    SACConfig,
    TaskConfig,
    TD3Config,
    UniformReplayConfig,
)


def needs(package):
    missing = importlib.util.find_spec(package) is None
    return pytest.mark.skipif(missing, reason=f"{package} is not installed")


BULLET = "pybullet_envs_gymnasium:{}BulletEnv-v0"
MUJOCO, BOX2D, BUILT_IN = needs("mujoco"), needs("Box2D"), ()
TASKS = {
    "Pendulum-v1": BUILT_IN,
    "Hopper-v5": MUJOCO,
    "HalfCheetah-v5": MUJOCO,
    "LunarLanderContinuous-v3": BOX2D,
    "BipedalWalker-v3": BOX2D,
    BULLET.format("Walker2D"): BUILT_IN,
    BULLET.format("HalfCheetah"): BUILT_IN,
}
ALGORITHMS = {
    "ppo_rpe": PPORPEConfig(replay_ratio=2.0),
    "sac": SACConfig(random_frames=250, hidden=(32,)),
    "td3": TD3Config(random_frames=250, hidden=(32,)),
    "ppo": PPOConfig(frames=100, epochs=2),
}
PAIRS = [(name, task, marks) for name in ALGORITHMS for task, marks in TASKS.items()]
# One task of each simulator, and each algorithm once.
QUICK = {
    ("ppo_rpe", "Hopper-v5"),
    ("sac", "LunarLanderContinuous-v3"),
    ("td3", "HalfCheetah-v5"),
    ("ppo", BULLET.format("Walker2D")),
}


@pytest.mark.parametrize(
    ("name", "env_id"),
    [
        pytest.param(
            name,
            task,
            marks=[
                *([marks] if marks else []),
                *([] if (name, task) in QUICK else [pytest.mark.slow]),
            ],
        )
        for name, task, marks in PAIRS
    ],
)
def test_300_frames_of_every_algorithm_on_every_task(name, env_id):
    """Each is learned from and tested, with all numbers finite."""
    replay = RolloutReplayConfig if name == "ppo" else UniformReplayConfig
    run = Experiment(
        ExperimentConfig(
            task=TaskConfig("task", env_id, frames=300, max_steps=100),
            algorithm=ALGORITHMS[name],
            replay=replay(batch_size=32),
            optimizer=AdamConfig(),
            compile=False,
            test_episodes=1,
        )
    )
    before = [parameter.clone() for parameter in run.agent.policy.parameters()]
    rows = run.train()
    assert rows[-1]["frames"] >= 300 and run.learner.updates > 0
    moved = zip(before, run.agent.policy.parameters(), strict=True)
    assert any(not b.equal(p) for b, p in moved)
    assert len(run.test().returns) == 1
