"""What every algorithm's settings have in common."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from pydantic import Field

from torchrl_l2c2.experiment.settings import SettingError, settings

if TYPE_CHECKING:
    from torchrl.envs import EnvBase

    from torchrl_l2c2.experiment.algorithms.agent import Agent
    from torchrl_l2c2.experiment.optimizers import OptimizerConfig
    from torchrl_l2c2.experiment.regularizers import RegularizerConfig

Layers = tuple[Annotated[int, Field(ge=1, le=1_000_000)], ...]
"""Neurons of hidden layers."""


class AlgorithmConfig:
    """Makes an agent; says what it usually learns from and with, and when.

    Attributes:
        usual_replay: name of the replay buffer that it comes with.
        usual_optimizer: name of the optimizer that it comes with.
        frames: least that an update learns from; 0 where a replay buffer has them.
        num_envs: simulators that one policy plays at once; ``None`` where it plays one.
        random_frames: played with random actions before learning starts.
    """

    usual_replay: ClassVar[str] = "uniform"
    usual_optimizer: ClassVar[str] = "adam"

    frames: int = 0
    num_envs: int | None = None
    random_frames: int = 0

    name: str
    gamma: float
    reward_scale: float | None
    schedule: str

    def make_agent(
        self, env: EnvBase, regularizer: RegularizerConfig, optimizer: OptimizerConfig
    ) -> Agent:
        """Builds the agent for an environment's observation and action.

        Raises:
            ValueError: a setting outside its range, or actions that the algorithm cannot take.
        """
        raise NotImplementedError

    @property
    def reward_factor(self) -> float:
        """What rewards are multiplied with to be learned from."""
        return 1.0 - self.gamma if self.reward_scale is None else self.reward_scale


class OffPolicyConfig(AlgorithmConfig):
    """An algorithm that learns from a replay buffer.

    Attributes:
        usual_replay_ratio: the default of ``replay_ratio``.
    """

    usual_replay_ratio: ClassVar[float | None] = None

    replay_ratio: float | None
    updates: int | None

    def __post_init__(self) -> None:
        # A usual ratio gives way to a number of updates, a chosen one does not.
        chosen = self.replay_ratio not in (None, self.usual_replay_ratio)
        if chosen and self.updates is not None:
            raise SettingError(
                "replay_ratio",
                f"and updates both say how many updates there are: leave one at null, got "
                f"{self.replay_ratio} and {self.updates}.",
            )

    def updates_after(self, frames: int, last_frame: int, stored: int, batch_size: int) -> int:
        """How many updates follow some frames.

        Args:
            frames (int): frames that were played.
            last_frame (int): frames of the run up to and with them.
            stored (int): transitions in the replay buffer.
            batch_size (int): transitions that an update draws.
        """
        if self.updates is not None:
            return self.updates
        if self.replay_ratio is None:
            return 1 if self.schedule == "step" else stored // batch_size
        # A fraction of an update is made up for later.
        each = self.replay_ratio / batch_size
        return int(each * last_frame) - int(each * (last_frame - frames))


@settings
class PerStepConfig(OffPolicyConfig):
    """One that makes an update after every step, with target networks that follow."""

    name: str = ""
    gamma: float = Field(default=0.99, ge=0, lt=1, description="discount")
    tau: float = Field(default=0.005, gt=0, le=1, description="pace of the target networks")
    random_frames: int = Field(
        default=1000, ge=0, description="frames with random actions, before learning starts"
    )
    reward_scale: float | None = Field(
        default=1.0, gt=0, description="factor on rewards while learning; null: 1 - gamma"
    )
    schedule: Literal["step", "episode"] = Field(default="step", description="when updates happen")
    replay_ratio: float | None = Field(
        default=None,
        gt=0,
        description="times that a transition is drawn on average, instead of updates: "
        "ratio * frames / batch_size of them",
    )
    updates: int | None = Field(
        default=1,
        ge=1,
        description="per step, or per episode; null: by the replay ratio, else one, or one pass "
        "over the buffer",
    )
