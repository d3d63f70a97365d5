"""Every loss of TorchRL that can be regularized, with tiny networks and made-up batches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import (
    CompositeDistribution,
    TensorDictModule,
    TensorDictSequential,
)
from torch import Tensor, nn
from torch.distributions import Categorical
from torchrl.data import Bounded, OneHot
from torchrl.modules import (
    MLP,
    Actor,
    BatchRenorm1d,
    DistributionalQValueActor,
    NormalParamExtractor,
    OneHotCategorical,
    ProbabilisticActor,
    QValueActor,
    QValueModule,
    TanhNormal,
    ValueOperator,
    VDNMixer,
)
from torchrl.objectives import (
    A2CLoss,
    BCLoss,
    ClipPPOLoss,
    CQLLoss,
    CrossQLoss,
    DDPGLoss,
    DiscreteCQLLoss,
    DiscreteIQLLoss,
    DiscreteSACLoss,
    DistributionalDQNLoss,
    DQNLoss,
    IQLLoss,
    KLPENPPOLoss,
    LossModule,
    PPOLoss,
    QMixerLoss,
    REDQLoss,
    ReinforceLoss,
    SACLoss,
    TD3BCLoss,
    TD3Loss,
    TQCLoss,
)
from torchrl.objectives.multiagent import IPPOLoss, MAPPOLoss

from torchrl_l2c2 import PPORPELoss

OBSERVATION, ACTION, ACTIONS, AGENTS, ATOMS = 3, 2, 4, 5, 6


@dataclass(frozen=True)
class Case:
    """A loss, a batch for it, and what regularizing it should bring."""

    name: str
    make: Callable[..., LossModule]
    batch: Callable[..., TensorDictBase]
    policy: str | None  # its diagnostic
    values: tuple[str, ...]  # its terms
    weighted: bool = False  # whether it uses the weights of prioritized replay
    fullgraph: bool = True  # whether the plain loss compiles into one graph, given the advantage
    continuous: bool = True  # whether the policy's actions are
    reductions: tuple[str, ...] = ("mean", "sum", "none")
    has_targets: bool = True
    declares_keys: bool = True  # whether the plain loss has in_keys and out_keys
    keywords: bool = True  # whether it can be called with keyword arguments
    selects: bool = True  # whether select_out_keys works on it: it needs all in_keys in the batch
    trajectories: bool = True  # whether it takes batches of shape [B, T]

    def __str__(self) -> str:
        return self.name

    @property
    def observation(self) -> NestedKey:
        """The key of the state."""
        team = self.batch in (agents_batch, discrete_agents_batch)
        return ("agents", "observation") if team else "observation"

    @property
    def terms(self) -> list[str]:
        """The keys that start with ``loss_l2c2``."""
        policy = [] if self.policy is None else ["loss_l2c2_actor"]
        return policy + [f"loss_l2c2_{value}" for value in self.values]


def mlp(inputs: int, outputs: int) -> nn.Module:
    """A small network that is not linear; several inputs are concatenated."""
    return MLP(in_features=inputs, out_features=outputs, num_cells=[8], activation_class=nn.Tanh)


def gaussian_actor(action: int = ACTION, prefix: tuple[str, ...] = ()) -> ProbabilisticActor:
    """A squashed normal policy, whose entries lie below ``prefix``."""
    keys = {name: (*prefix, name) for name in ("observation", "loc", "scale", "action")}
    net = nn.Sequential(mlp(OBSERVATION, 2 * action), NormalParamExtractor())
    module = TensorDictModule(net, [keys["observation"]], [keys["loc"], keys["scale"]])
    return ProbabilisticActor(
        module,
        in_keys=[keys["loc"], keys["scale"]],
        out_keys=[keys["action"]],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )


def one_hot_actor() -> ProbabilisticActor:
    """A policy over one-hot actions."""
    module = TensorDictModule(mlp(OBSERVATION, ACTIONS), ["observation"], ["logits"])
    return ProbabilisticActor(
        module, in_keys=["logits"], distribution_class=OneHotCategorical, return_log_prob=True
    )


def composite_actor() -> ProbabilisticActor:
    """A policy of two heads: a squashed normal one and a categorical one."""

    class Heads(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.net = mlp(OBSERVATION, 2 * ACTION + ACTIONS)
            self.normal = NormalParamExtractor()

        def forward(self, observation: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            normal, logits = self.net(observation).split([2 * ACTION, ACTIONS], -1)
            return *self.normal(normal), logits

    parameters = [
        ("params", "move", "loc"),
        ("params", "move", "scale"),
        ("params", "pick", "logits"),
    ]
    return ProbabilisticActor(
        TensorDictModule(Heads(), ["observation"], parameters),
        in_keys=["params"],
        out_keys=["move", "pick"],
        distribution_class=CompositeDistribution,
        distribution_kwargs={"distribution_map": {"move": TanhNormal, "pick": Categorical}},
        return_log_prob=True,
    )


def deterministic_actor() -> Actor:
    return Actor(nn.Sequential(mlp(OBSERVATION, ACTION), nn.Tanh()))


def critic() -> ValueOperator:
    return ValueOperator(mlp(OBSERVATION, 1), in_keys=["observation"])


def qvalue() -> ValueOperator:
    return ValueOperator(mlp(OBSERVATION + ACTION, 1), in_keys=["observation", "action"])


def quantiles() -> ValueOperator:
    """A critic of three quantiles of the return."""
    return ValueOperator(mlp(OBSERVATION + ACTION, 3), in_keys=["observation", "action"])


def action_values(key: str = "action_value") -> TensorDictModule:
    return TensorDictModule(mlp(OBSERVATION, ACTIONS), ["observation"], [key])


def batch_norm_qvalue() -> ValueOperator:
    class Critic(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.net = nn.Sequential(
                nn.Linear(OBSERVATION + ACTION, 8), BatchRenorm1d(8), nn.Tanh(), nn.Linear(8, 1)
            )

        def forward(self, observation: Tensor, action: Tensor) -> Tensor:
            return self.net(torch.cat((observation, action), -1))

    return ValueOperator(Critic(), in_keys=["observation", "action"])


def heads_critic() -> TensorDictSequential:
    """Three heads and their mean."""
    heads = TensorDictModule(mlp(OBSERVATION, 3), ["observation"], ["state_value_heads"])
    mean = TensorDictModule(
        lambda x: x.mean(-1, keepdim=True), ["state_value_heads"], ["state_value"]
    )
    return TensorDictSequential(heads, mean)


def transitions(*shape: int, action: Tensor | None = None) -> TensorDict:
    """A batch of made-up transitions."""
    done = torch.zeros(*shape, 1, dtype=torch.bool)
    return TensorDict(
        {
            "observation": torch.randn(*shape, OBSERVATION),
            "action": torch.rand(*shape, ACTION) - 0.5 if action is None else action,
            "next": {
                "observation": torch.randn(*shape, OBSERVATION),
                "reward": torch.randn(*shape, 1),
                "done": done,
                "terminated": done.clone(),
            },
        },
        batch_size=shape,
    )


def on_policy(*shape: int) -> TensorDict:
    """Made-up transitions with what the acting policy and its advantages leave in them."""
    batch = transitions(*shape)
    return batch.update(
        {
            "action_log_prob": torch.randn(*shape) / 10,
            "loc": torch.randn(*shape, ACTION) / 10,
            "scale": torch.rand(*shape, ACTION) + 0.5,
        }
    )


def composite_batch(*shape: int) -> TensorDict:
    batch = transitions(*shape).exclude("action")
    return batch.update(
        {
            "move": torch.rand(*shape, ACTION) - 0.5,
            "pick": torch.randint(ACTIONS, shape),
            "move_log_prob": torch.randn(*shape) / 10,
            "pick_log_prob": torch.randn(*shape) / 10,
        }
    )


def one_hot_batch(*shape: int) -> TensorDict:
    action = nn.functional.one_hot(torch.randint(ACTIONS, shape), ACTIONS)
    return transitions(*shape, action=action.float())


def agents_batch(*shape: int) -> TensorDict:
    """A team's transitions: observations and actions of the agents, one reward."""
    team = (*shape, AGENTS)
    batch = transitions(*shape).exclude("observation", "action", ("next", "observation"))
    for root in (batch, batch["next"]):
        observation = torch.randn(*team, OBSERVATION)
        root["agents"] = TensorDict({"observation": observation}, batch_size=team)
    batch["agents"].update(
        {
            "action": torch.rand(*team, ACTION) - 0.5,
            "action_log_prob": torch.randn(*team) / 10,
        }
    )
    return batch


def discrete_agents_batch(*shape: int) -> TensorDict:
    """The same with one-hot actions."""
    batch = agents_batch(*shape)
    actions = torch.randint(ACTIONS, (*shape, AGENTS))
    batch["agents", "action"] = nn.functional.one_hot(actions, ACTIONS)
    return batch


def make_composite_ppo(**kwargs: Any) -> PPOLoss:
    loss = PPOLoss(composite_actor(), critic(), **kwargs)
    loss.set_keys(action=["move", "pick"], sample_log_prob=["move_log_prob", "pick_log_prob"])
    return loss


def make_mappo(loss_class: type[MAPPOLoss] = MAPPOLoss, **kwargs: Any) -> MAPPOLoss:
    """With agents that all have the same networks, in the centralized or independent class."""
    value = TensorDictModule(
        mlp(OBSERVATION, 1), [("agents", "observation")], [("agents", "state_value")]
    )
    loss = loss_class(gaussian_actor(prefix=("agents",)), value, **kwargs)
    loss.set_keys(
        action=("agents", "action"),
        value=("agents", "state_value"),
        sample_log_prob=("agents", "action_log_prob"),
    )
    return loss


def make_qmixer() -> QMixerLoss:
    values = TensorDictModule(
        mlp(OBSERVATION, ACTIONS), [("agents", "observation")], [("agents", "action_value")]
    )
    select = QValueModule(
        action_value_key=("agents", "action_value"),
        out_keys=[
            ("agents", "action"),
            ("agents", "action_value"),
            ("agents", "chosen_action_value"),
        ],
        action_space="one-hot",
    )
    mixer = TensorDictModule(
        VDNMixer(n_agents=AGENTS, device="cpu"),
        [("agents", "chosen_action_value")],
        ["chosen_action_value"],
    )
    return QMixerLoss(TensorDictSequential(values, select), mixer, action_space="one-hot")


def make_distributional_dqn(**kwargs: Any) -> DistributionalDQNLoss:
    net = nn.Sequential(mlp(OBSERVATION, ATOMS * ACTIONS), nn.Unflatten(-1, (ATOMS, ACTIONS)))
    actor = DistributionalQValueActor(
        net,
        support=torch.linspace(-1.0, 1.0, ATOMS),
        action_space="one-hot",
        spec=OneHot(ACTIONS),
    )
    return DistributionalDQNLoss(actor, gamma=0.9, **kwargs)


BOUNDS = Bounded(-1.0, 1.0, (ACTION,))
HELLINGER, DISTANCE = "l2c2_hellinger", "l2c2_action_distance"

CASES = [
    Case(
        "PPO",
        lambda **kw: PPOLoss(gaussian_actor(), critic(), **kw),
        on_policy,
        HELLINGER,
        ("critic",),
        has_targets=False,
    ),
    Case(
        "ClipPPO",
        lambda **kw: ClipPPOLoss(gaussian_actor(), critic(), **kw),
        on_policy,
        HELLINGER,
        ("critic",),
        has_targets=False,
    ),
    Case(
        "KLPENPPO",
        lambda **kw: KLPENPPOLoss(gaussian_actor(), critic(), **kw),
        on_policy,
        HELLINGER,
        ("critic",),
        has_targets=False,
        fullgraph=False,
    ),
    Case(
        "PPO-composite",
        make_composite_ppo,
        composite_batch,
        HELLINGER,
        ("critic",),
        has_targets=False,
        selects=False,
        continuous=False,
        fullgraph=False,  # It does, but then draws other neighbors.
    ),
    Case(
        "MAPPO",
        make_mappo,
        agents_batch,
        HELLINGER,
        ("critic",),
        has_targets=False,
        keywords=False,
    ),
    Case(
        "IPPO",
        lambda **kw: make_mappo(IPPOLoss, **kw),
        agents_batch,
        HELLINGER,
        ("critic",),
        has_targets=False,
        keywords=False,
    ),
    Case(
        "A2C",
        lambda **kw: A2CLoss(gaussian_actor(), critic(), **kw),
        on_policy,
        HELLINGER,
        ("critic",),
        has_targets=False,
    ),
    Case(
        "Reinforce",
        lambda **kw: ReinforceLoss(gaussian_actor(), critic(), **kw),
        on_policy,
        HELLINGER,
        ("critic",),
        has_targets=False,
    ),
    Case(
        "PPORPE",
        lambda **kw: PPORPELoss(gaussian_actor(), heads_critic(), **kw),
        on_policy,
        HELLINGER,
        ("critic",),
        weighted=True,
    ),
    Case(
        "SAC",
        lambda **kw: SACLoss(gaussian_actor(), qvalue(), action_spec=BOUNDS, **kw),
        transitions,
        HELLINGER,
        ("qvalue",),
        weighted=True,
    ),
    Case(
        "SAC-v1",
        lambda **kw: SACLoss(
            gaussian_actor(), qvalue(), critic(), action_spec=BOUNDS, delay_value=True, **kw
        ),
        transitions,
        HELLINGER,
        ("qvalue", "value"),
        weighted=True,
    ),
    Case(
        "TQC",
        lambda **kw: TQCLoss(
            gaussian_actor(), quantiles(), num_qvalue_nets=2, action_spec=BOUNDS, **kw
        ),
        transitions,
        HELLINGER,
        ("qvalue",),
        weighted=True,
    ),
    Case(
        "DiscreteSAC",
        lambda **kw: DiscreteSACLoss(
            one_hot_actor(), action_values(), action_space="one-hot", num_actions=ACTIONS, **kw
        ),
        one_hot_batch,
        HELLINGER,
        ("qvalue",),
        weighted=True,
        continuous=False,
    ),
    Case(
        "DDPG",
        lambda **kw: DDPGLoss(deterministic_actor(), qvalue(), **kw),
        transitions,
        DISTANCE,
        ("value",),
        weighted=True,
        selects=False,
    ),
    Case(
        "TD3",
        lambda **kw: TD3Loss(deterministic_actor(), qvalue(), action_spec=BOUNDS, **kw),
        transitions,
        DISTANCE,
        ("qvalue",),
        weighted=True,
    ),
    Case(
        "TD3BC",
        lambda **kw: TD3BCLoss(deterministic_actor(), qvalue(), action_spec=BOUNDS, **kw),
        transitions,
        DISTANCE,
        ("qvalue",),
        weighted=True,
    ),
    Case(
        "REDQ",
        lambda **kw: REDQLoss(
            gaussian_actor(), qvalue(), num_qvalue_nets=3, action_spec=BOUNDS, **kw
        ),
        transitions,
        HELLINGER,
        ("qvalue",),
        selects=False,
    ),
    Case(
        "IQL",
        lambda **kw: IQLLoss(gaussian_actor(), qvalue(), critic(), **kw),
        transitions,
        HELLINGER,
        ("qvalue", "value"),
    ),
    Case(
        "DiscreteIQL",
        lambda **kw: DiscreteIQLLoss(
            one_hot_actor(),
            action_values("state_action_value"),
            critic(),
            action_space="one-hot",
            **kw,
        ),
        one_hot_batch,
        HELLINGER,
        ("qvalue", "value"),
        continuous=False,
    ),
    Case(
        "BC",
        lambda **kw: BCLoss(gaussian_actor(), **kw),
        transitions,
        HELLINGER,
        (),
        has_targets=False,
    ),
    Case(
        "deterministic BC",
        lambda **kw: BCLoss(deterministic_actor(), **kw),
        transitions,
        DISTANCE,
        (),
        has_targets=False,
    ),
    Case(
        "CQL",
        lambda **kw: CQLLoss(gaussian_actor(), qvalue(), action_spec=BOUNDS, **kw),
        transitions,
        HELLINGER,
        ("qvalue",),
    ),
    Case(
        "DiscreteCQL",
        lambda **kw: DiscreteCQLLoss(
            QValueActor(action_values(), in_keys=["observation"], action_space="one-hot"),
            action_space="one-hot",
            **kw,
        ),
        one_hot_batch,
        None,
        ("value",),
    ),
    Case(
        "CrossQ",
        lambda **kw: CrossQLoss(gaussian_actor(), batch_norm_qvalue(), action_spec=BOUNDS, **kw),
        transitions,
        HELLINGER,
        ("qvalue",),
        has_targets=False,
        trajectories=False,
    ),
    Case(
        "DQN",
        lambda **kw: DQNLoss(
            QValueActor(action_values(), in_keys=["observation"], action_space="one-hot"),
            action_space="one-hot",
            **kw,
        ),
        one_hot_batch,
        None,
        ("value",),
        weighted=True,
    ),
    Case(
        "DistributionalDQN",
        make_distributional_dqn,
        one_hot_batch,
        None,
        ("value",),
        weighted=True,
        fullgraph=False,
        declares_keys=False,
        keywords=False,
    ),
    Case(
        "QMixer",
        make_qmixer,
        discrete_agents_batch,
        None,
        ("local_value",),
        reductions=("mean",),
        keywords=False,
    ),
]
