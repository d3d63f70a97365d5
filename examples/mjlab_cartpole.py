"""mjlab's cartpole with L2C2: a second task, with L2C2PPO in its runner's configuration.

``python examples/mjlab_cartpole.py Mjlab-Cartpole-Balance-L2C2`` trains it, and
``Mjlab-Cartpole-Balance`` the baseline. ``--agent.algorithm.regularizer-cfg.strength 2`` doubles
the penalty. Needs mjlab.

It trains on one GPU, or on a CPU. For several GPUs mjlab starts further processes, which know only
tasks of installed packages: register the task in a package with an entry point of the group
``mjlab.tasks``.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field

import mjlab.tasks  # noqa: F401  (registers mjlab's own tasks)
from mjlab.rl import RslRlPpoAlgorithmCfg
from mjlab.scripts.train import main
from mjlab.tasks.registry import load_env_cfg, load_rl_cfg, load_runner_cls, register_mjlab_task


@dataclass
class Regularizer:
    """Entries of ``regularizer_cfg``; each is an option of the command."""

    strength: float = 1.0


@dataclass
class L2C2AlgorithmCfg(RslRlPpoAlgorithmCfg):
    """mjlab's configuration of PPO, and the regularizer's."""

    class_name: str = "torchrl_l2c2.rsl_rl:L2C2PPO"
    regularizer_cfg: Regularizer = field(default_factory=Regularizer)


def register_with_l2c2(task: str) -> None:
    """Registers a task again, with ``-L2C2`` behind its name."""
    agent = load_rl_cfg(task)
    agent.experiment_name += "_l2c2"  # The baseline's runs have a folder of their own.
    settings = asdict(agent.algorithm)
    del settings["class_name"]
    agent.algorithm = L2C2AlgorithmCfg(**settings)
    register_mjlab_task(
        task_id=f"{task}-L2C2",
        env_cfg=load_env_cfg(task),
        play_env_cfg=load_env_cfg(task, play=True),
        rl_cfg=agent,
        runner_cls=load_runner_cls(task),
    )


register_with_l2c2("Mjlab-Cartpole-Balance")

if __name__ == "__main__":
    main()
