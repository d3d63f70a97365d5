"""L2C2 and CATS in rsl_rl's PPO, beside the same terms made of TorchRL's modules."""

from __future__ import annotations

import copy
import importlib
import inspect
import math
import re
import runpy
import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import IndependentNormal, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss

from torchrl_l2c2 import CATSLoss, L2C2Loss, Neighborhood, NeighborTransform, smooth
from torchrl_l2c2.gains import gradient_shares
from torchrl_l2c2.presets import preset

rsl = pytest.importorskip("torchrl_l2c2.rsl_rl", reason="needs the extra rsl-rl")

from rsl_rl.algorithms import PPO  # noqa: E402
from rsl_rl.models import MLPModel, RNNModel  # noqa: E402
from rsl_rl.storage import RolloutStorage  # noqa: E402

from torchrl_l2c2.rsl_rl.networks import ActorCriticLoss  # noqa: E402

ENVS, STEPS, ACTIONS = 6, 5, 2
GROUPS = {"actor": ["policy"], "critic": ["policy", "privileged"]}
NORMAL = {"class_name": "GaussianDistribution", "init_std": 0.5}


def observations(seed: int) -> TensorDict:
    """Of every environment, in two groups."""
    generator = torch.Generator().manual_seed(seed)
    draw = {"policy": 3, "privileged": 2}
    groups = {name: torch.randn(ENVS, size, generator=generator) for name, size in draw.items()}
    return TensorDict(groups, [ENVS])


def make(
    algorithm: type[PPO],
    model: type[MLPModel] = MLPModel,
    normal: Any = NORMAL,
    memory: tuple[str | None, str | None] = (None, None),
    **settings: Any,
) -> PPO:
    """An algorithm with the same networks each time; one batch a rollout unless told otherwise.

    ``memory``: the recurrent layers of the actor and the critic, ``"lstm"`` or ``"gru"``.
    """
    torch.manual_seed(0)
    obs = observations(0)
    small: dict[str, Any] = {"hidden_dims": [8], "activation": "tanh", "obs_normalization": True}
    # rsl_rl 5.4 updates a normalization in each step: recurrent states would be of older ones.
    layers = {"rnn_hidden_dim": 4, "rnn_num_layers": 2, "obs_normalization": False}
    models = []
    for kind in memory:
        recurrent = {"rnn_type": kind, **layers}
        models.append((model, small) if kind is None else (RNNModel, small | recurrent))
    (of_actor, actor_settings), (of_critic, critic_settings) = models
    # A copy: rsl_rl 5.4 takes the class's name out of the dictionary.
    normal = copy.copy(normal)
    actor = of_actor(obs, GROUPS, "actor", ACTIONS, distribution_cfg=normal, **actor_settings)
    critic = of_critic(obs, GROUPS, "critic", 1, **critic_settings)
    storage = RolloutStorage("rl", ENVS, STEPS, obs, [ACTIONS])
    settings = {"num_learning_epochs": 1, "num_mini_batches": 1} | settings
    return algorithm(actor, critic, storage, **settings)


def collected(ppo: PPO, dones: dict[int, list[int]] | None = None, **extras: Any) -> PPO:
    """A rollout in which steps end the episodes of some environments."""
    torch.manual_seed(1)
    normalize(ppo)
    with torch.inference_mode():
        for step in range(STEPS):
            ppo.act(observations(step))
            done = torch.zeros(ENVS)
            done[(dones or {}).get(step, [])] = 1
            reward = observations(step)["policy"][:, 0]
            ppo.process_env_step(observations(step + 1), reward, done, extras)
        ppo.compute_returns(observations(STEPS))
    return ppo


def transitions(order: Tensor) -> TensorDict:
    """What `collect` has made, in the order of a batch."""
    here = torch.stack([observations(step) for step in range(STEPS)]).flatten(0, 1)
    there = torch.stack([observations(step + 1) for step in range(STEPS)]).flatten(0, 1)
    return here.set("next", there)[order]


class Joined(nn.Module):
    """A network of rsl_rl's, in parts: the normalization, the layers, and the scale beside it."""

    def __init__(self, model: MLPModel) -> None:
        super().__init__()
        model = copy.deepcopy(model)
        self.normalizer, self.layers = model.obs_normalizer, model.mlp
        if model.distribution is not None:
            self.scale = model.distribution.std_param

    def forward(self, *groups: Tensor) -> Any:
        out = self.layers(self.normalizer(torch.cat(groups, -1)))
        return (out, self.scale.expand_as(out)) if hasattr(self, "scale") else out


def torchrl_loss(ppo: PPO) -> ClipPPOLoss:
    """TorchRL's PPO with copies of an algorithm's networks."""
    policy = TensorDictModule(Joined(ppo.actor), GROUPS["actor"], ["loc", "scale"])
    actor = ProbabilisticActor(
        policy, in_keys=["loc", "scale"], distribution_class=IndependentNormal
    )
    critic = TensorDictModule(Joined(ppo.critic), GROUPS["critic"], ["state_value"])
    return ClipPPOLoss(actor, critic, functional=False)


def normalize(ppo: PPO) -> None:
    """Gives the normalizations something to do."""
    obs = torch.stack([observations(seed).apply(lambda x: 3 * x + 1) for seed in range(9)])
    for model in (ppo.actor, ppo.critic):
        model.update_normalization(obs.flatten(0, 1))


def update(ppo: PPO) -> dict[str, float]:
    torch.manual_seed(5)
    return ppo.update()


def steps(ppo: PPO) -> tuple[list[Tensor], dict[str, float]]:
    """Gradients of an update, as steps of plain descent at a rate of 1; and what it returned."""
    ppo.optimizer = torch.optim.SGD([*ppo.actor.parameters(), *ppo.critic.parameters()], lr=1.0)
    before = [parameter.detach().clone() for parameter in parameters(ppo)]
    losses = update(ppo)
    return [a - b.detach() for a, b in zip(before, parameters(ppo), strict=True)], losses


def check_added(plain: PPO, ppo: PPO, terms: TensorDictBase, base: ClipPPOLoss) -> None:
    """The one's update differs from the other's by the gradients of the terms, and tells them."""
    expected = gradients(terms, base)
    (without, _), (with_terms, losses) = steps(plain), steps(ppo)
    found = [a - b for a, b in zip(with_terms, without, strict=True)]
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-6)
    told = {name: losses[name.removeprefix("loss_")] for name in terms.keys()}
    assert told == pytest.approx({name: term.item() for name, term in terms.items()}, rel=1e-4)


def parameters(ppo: PPO) -> list[Tensor]:
    return [
        *(p for net in (ppo.actor, ppo.critic) for p in net.mlp.parameters()),
        ppo.actor.distribution.std_param,
    ]


def gradients(terms: TensorDictBase, loss: ClipPPOLoss) -> list[Tensor]:
    """Of the terms of a loss that `torchrl_loss` has made, in the order of `parameters`."""
    sum(term for name, term in terms.items() if name.startswith("loss_")).backward()
    nets = [*loss.actor_network.modules(), *loss.critic_network.modules()]
    joined = [net for net in nets if isinstance(net, Joined)]
    weights = [weight for net in joined for weight in net.layers.parameters()]
    return [torch.zeros_like(p) if p.grad is None else p.grad for p in [*weights, joined[0].scale]]


FIXED = {"schedule": "fixed", "max_grad_norm": 1e9}
NEAR = {"sigma": 1.5, "lambda_min": 0.2, "lambda_max": 2.0, "neighbors": "box"}
PAPER = {"policy_distance": "hellinger", "beta": 0.1}


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"policy_distance": "mean", "coeff": 0.5},
        {"policy_distance": "kl", "num_samples": 3},
        {"beta": 0.0},
    ],
    ids=["hellinger", "mean", "kl", "no_value_term"],
)
def test_terms_and_gradients_are_those_of_the_loss_for_torchrl(options: dict[str, Any]) -> None:
    """On the same states and draws, with normalizations and a critic that sees more."""
    plain = collected(make(PPO, **FIXED))
    options = {**PAPER, **options}
    ppo = collected(make(rsl.L2C2PPO, regularizer_cfg={**NEAR, **options}, **FIXED))

    near = Neighborhood(**NEAR)
    base = torchrl_loss(ppo)
    loss = L2C2Loss(base, near, **options)
    groups = GROUPS["critic"] if options.get("beta") != 0.0 else GROUPS["actor"]
    generator = torch.Generator().manual_seed(0)  # that of make's torch.manual_seed(0)
    draw = NeighborTransform(near, groups, num_samples=loss.l2c2_num_samples, generator=generator)
    torch.manual_seed(5)
    batch = draw(transitions(torch.randperm(ENVS * STEPS)))
    terms = loss.policy_regularizer(batch).update(loss.value_regularizer(batch))
    check_added(plain, ppo, terms, base)


def test_it_reports_the_terms_that_it_added_and_what_they_are_made_of() -> None:
    """At constant gains of the neighborhood's edge the terms are multiples of the distances."""
    near = {"lambda_min": 0.1, "lambda_max": 0.1000001, **PAPER}
    ppo = collected(make(rsl.L2C2PPO, regularizer_cfg={**near, "beta": 0.5, "coeff": 2.0}))
    losses = update(ppo)
    assert losses["l2c2_gain"] == pytest.approx(0.2, rel=1e-4)
    assert losses["l2c2_actor"] == pytest.approx(0.2 * losses["l2c2_hellinger"], rel=1e-4)
    assert losses["l2c2_critic"] == pytest.approx(0.1 * losses["l2c2_value_distance"], rel=1e-4)
    assert "symmetry" not in losses


@pytest.mark.parametrize(
    "algorithm, given, method",
    [
        (rsl.L2C2PPO, {"ramp_updates": None}, "l2c2"),
        (rsl.CATSPPO, {"lambda_temporal": 0.3}, "cats"),
        # Without the noise, which the actions of rsl_rl's update are drawn before.
        (rsl.RegularizedPPO, {"method": "caps", "lambda_spatial": 0.0, "strength": 3.0}, "caps"),
    ],
)
def test_the_terms_are_those_of_smooth(
    algorithm: type[PPO], given: dict[str, Any], method: str
) -> None:
    """Their values and gradients, with the preset of TorchRL's PPO and what replaces it."""
    plain = collected(make(PPO, **FIXED))
    ppo = collected(make(algorithm, regularizer_cfg=given, **FIXED))
    base = torchrl_loss(ppo)
    settings = {name: value for name, value in given.items() if name.startswith("lambda_")}
    loss = smooth(base, method, given.get("strength", 1.0), fold=False, ramp=None, **settings)
    torch.manual_seed(5)  # as in update
    batch = transitions(torch.randperm(ENVS * STEPS))
    if isinstance(loss, L2C2Loss):
        generator = torch.Generator().manual_seed(0)  # that of make's torch.manual_seed(0)
        batch = loss.neighbor_transform(generator)(batch)
    check_added(plain, ppo, loss.policy_regularizer(batch), base)


def test_zero_rewards_leave_a_shared_deviation_where_it_is() -> None:
    """As without a regularizer; the Hellinger distance and the KL are lowered by a larger one."""

    def deviation(algorithm: type[PPO], **cfg: Any) -> float:
        ppo = make(algorithm, normal=NORMAL | {"init_std": 0.3}, entropy_coef=0.0, **cfg)
        torch.nn.init.zeros_(ppo.critic.mlp[-1].weight)  # No advantages: no noise of the surrogate.
        torch.nn.init.zeros_(ppo.critic.mlp[-1].bias)
        for _ in range(30):
            for step in range(STEPS):
                ppo.act(observations(step))
                ppo.process_env_step(
                    observations(step + 1), torch.zeros(ENVS), torch.zeros(ENVS), {}
                )
            ppo.compute_returns(observations(STEPS))
            ppo.update()
        return ppo.actor.distribution.std_param.max().item()

    still = deviation(PPO)
    assert still == pytest.approx(0.3)
    for algorithm in (rsl.L2C2PPO, rsl.CATSPPO):
        assert deviation(algorithm) == still
    for distance in ("hellinger", "kl"):
        assert deviation(rsl.L2C2PPO, regularizer_cfg={"policy_distance": distance}) > 0.31


@pytest.mark.parametrize(
    "given, said",
    [
        (
            {},
            "L2C2PPO: method='l2c2', policy_distance='mse', neighbors='line', lambda_min=1.0, "
            "lambda_max=100.0, beta=0.0, strength=1.0 (the preset: there is no regularizer_cfg). "
            "The gain is constant; for the preset's ramp, set ramp_updates in regularizer_cfg to "
            "the number of the runner's iterations (max_iterations).",
        ),
        (
            {"max_iterations": 30, "regularizer_cfg": {"beta": 0.5, "strength": 2}},
            "L2C2PPO: method='l2c2', policy_distance='mse', neighbors='line', lambda_min=1.0, "
            "lambda_max=100.0, beta=0.5, strength=2. The gain rises over 30 updates.",
        ),
    ],
)
def test_one_line_says_what_is_trained_with(
    given: dict[str, Any], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Also if nothing was given, as by a class name alone."""
    make(rsl.L2C2PPO, **given)
    assert capsys.readouterr().out == said + "\n"


def test_an_explicit_ramp_goes_before_the_runners_iterations() -> None:
    """``None`` is a constant gain; methods whose preset has no ramp have none."""
    for cfg, updates in (
        ({"ramp_updates": 7}, 7),
        ({"ramp_updates": None}, None),
        ({"method": "caps"}, None),
        ({"method": "cats"}, 30),
    ):
        ppo = make(rsl.RegularizedPPO, regularizer_cfg=cfg, max_iterations=30)
        assert ppo.regularization.ramp_updates == updates
        assert ppo.regularization.loss.regularizer_gain == (1.0 if updates is None else 0.0)


@pytest.mark.parametrize(
    "cfg",
    [
        {"method": "caps"},
        {"method": "lcp"},
        {"method": "lcp", "of": "log_prob"},
        {"method": "sr2l"},
    ],
    ids=["caps", "lcp", "lcp of log_prob", "sr2l"],
)
def test_other_methods_train(cfg: dict[str, Any]) -> None:
    """Their terms are logged, and the actor's update is another."""
    method = cfg["method"]
    plain, ppo = make(PPO), make(rsl.RegularizedPPO, regularizer_cfg=cfg | {"strength": 100.0})
    losses = [update(collected(each)) for each in (plain, ppo)]
    terms = [value for name, value in losses[1].items() if name.startswith(method)]
    assert terms and min(terms) > 0
    assert losses[1].keys() > losses[0].keys()
    assert not torch.equal(parameters(plain)[0], parameters(ppo)[0])


@pytest.mark.parametrize(
    "algorithm, method, said",
    [
        (rsl.RegularizedPPO, "asap", "'asap', which needs the observation before each state"),
        (
            rsl.RegularizedPPO,
            "l2c3",
            "method must be 'l2c2' or 'caps' or 'cats' or 'lcp' or 'sr2l', got 'l2c3'",
        ),
        (rsl.L2C2PPO, "cats", "method 'l2c2' of L2C2PPO, got 'cats'. Use .*:RegularizedPPO"),
    ],
)
def test_methods_that_do_not_work_here_are_refused(
    algorithm: type[PPO], method: str, said: str
) -> None:
    """With those that do."""
    with pytest.raises(ValueError, match=said):
        make(algorithm, regularizer_cfg={"method": method})


@pytest.mark.parametrize("distribution", ["Gaussian", "HeteroscedasticGaussian"])
@pytest.mark.parametrize(
    "algorithm, off", [(rsl.L2C2PPO, {"coeff": 0.0}), (rsl.CATSPPO, {"lambda_temporal": 0.0})]
)
def test_a_gain_of_zero_leaves_every_number_of_training(
    algorithm: type[PPO], off: dict[str, float], distribution: str
) -> None:
    """Networks, their normalizations, rates of learning and actions, over several rollouts."""
    ended = []
    normal = {"class_name": f"{distribution}Distribution"}
    for cls, extra in ((PPO, {}), (algorithm, {"regularizer_cfg": off})):
        ppo = make(cls, normal=normal, num_learning_epochs=2, num_mini_batches=3, **extra)
        for _ in range(3):
            collected(ppo, dones={1: [0, 3]})
            ppo.update()
        networks = [*ppo.actor.state_dict().values(), *ppo.critic.state_dict().values()]
        rest = [torch.tensor(ppo.learning_rate), torch.rand(1), ppo.actor.output_std]
        ended.append([*networks, *rest])
    for plain, regularized in zip(*ended, strict=True):
        assert torch.equal(plain, regularized)


def small_storage() -> Any:
    """Of two environments and three steps, which see 10 times the step plus the environment."""
    first = TensorDict({"policy": torch.tensor([[0.0], [1.0]])}, [2])
    storage = rsl.SuccessorStorage(RolloutStorage("rl", 2, 3, first, [1]))
    storage.distribution_params = (torch.zeros(3, 2, 1),)
    storage.observations["policy"].copy_(10.0 * torch.arange(3).reshape(3, 1, 1) + first["policy"])
    storage.add_last(first + 30.0)
    return storage


def known_successors(storage: Any) -> dict[float, float]:
    """By the observations of all batches, what came next."""
    batches = list(storage.mini_batch_generator(2, num_epochs=1))
    here = torch.cat([batch.observations["policy"][batch.has_next] for batch in batches])
    there = torch.cat([batch.next_observations["policy"][batch.has_next] for batch in batches])
    assert not any("_row" in batch.observations.keys() for batch in batches)
    return dict(zip(here.flatten().tolist(), there.flatten().tolist(), strict=True))


def test_next_observations_are_found_by_their_time() -> None:
    """In every environment's own rollout, the last step's among them, but not past an end."""
    storage = small_storage()
    assert known_successors(storage) == {0: 10, 10: 20, 20: 30, 1: 11, 11: 21, 21: 31}
    storage.dones[1, 0] = 1
    storage.dones[2, 1] = 1
    assert known_successors(storage) == {0: 10, 20: 30, 1: 11, 11: 21}


def test_final_observations_take_the_place_of_those_after_the_reset() -> None:
    """Of the environments whose episodes the step has ended, until the storage is cleared."""
    storage = small_storage()
    storage.dones[1, 0] = 1
    storage.step = 2  # steps 0 and 1 are stored
    given = TensorDict({"policy": torch.tensor([[-5.0], [-6.0]])}, [2])
    storage.add_final(given, torch.tensor([True, False]))
    assert known_successors(storage) == {0: 10, 10: -5, 20: 30, 1: 11, 11: 21, 21: 31}
    storage.clear()
    assert 10 not in known_successors(storage)


def test_observations_are_stored_once() -> None:
    """Besides the last step's, there is one row of them for each step."""
    storage = small_storage()
    own = storage.observations["policy"].untyped_storage()
    assert own.nbytes() == (3 + 1) * 2 * 4
    holders = [part for part in vars(storage).values() if isinstance(part, TensorDict)]
    assert {part["policy"].untyped_storage().data_ptr() for part in holders} == {own.data_ptr()}


def test_terms_are_means_over_the_transitions_without_resets() -> None:
    """The reset's observations do not matter, and ended rows do not dilute the mean."""
    ends = {STEPS - 1: [0, 2], 1: [4]}
    ppo = collected(make(rsl.CATSPPO), dones=ends)
    after = observations(STEPS)
    after[ends[STEPS - 1]] = after[ends[STEPS - 1]] * 1e6
    ppo.storage.add_last(after)
    known = torch.ones(STEPS, ENVS, dtype=torch.bool)
    for step, environments in ends.items():
        known[step, environments] = False
    batch = transitions(known.flatten().nonzero().flatten())
    term = CATSLoss(torchrl_loss(ppo)).policy_regularizer(batch)["loss_cats"]
    assert update(ppo)["cats"] == pytest.approx(term.item(), rel=1e-5)


def test_the_environments_final_observations_are_used() -> None:
    """Where its extras have them, no transition is left out."""
    ppo = collected(make(rsl.CATSPPO), dones={2: [1]}, final_obs=observations(77))
    batch = transitions(torch.arange(ENVS * STEPS))
    batch["next"][2 * ENVS + 1] = observations(77)[1]
    term = CATSLoss(torchrl_loss(ppo)).policy_regularizer(batch)["loss_cats"]
    assert update(ppo)["cats"] == pytest.approx(term.item(), rel=1e-5)


def test_final_observations_that_lack_a_group_are_refused() -> None:
    """In the step that has them, with what is missing; not later in the update."""
    with pytest.raises(KeyError, match=r"'final_obs'.* got none of \['policy'\]"):
        collected(make(rsl.CATSPPO), final_obs=observations(77).select("privileged"))
    both = {"regularizer_cfg": {"beta": 1.0}}
    with pytest.raises(KeyError, match=r"'final_obs'.* got none of \['privileged'\]"):
        collected(make(rsl.L2C2PPO, **both), final_obs=observations(77).select("policy"))


def test_only_what_the_regularizer_reads_is_looked_up() -> None:
    """The critic's own group is not, if the critic has no term, also not among the last ones."""
    ends = {"dones": {2: [1]}}
    whole, part = (
        update(collected(make(rsl.CATSPPO), **ends, final_obs=observations(77).select(*groups)))
        for groups in (("policy", "privileged"), ("policy",))
    )
    assert whole == part
    ppo = collected(make(rsl.CATSPPO))
    (batch,) = ppo.storage.mini_batch_generator(1, 1)
    assert list(batch.next_observations.keys()) == ["policy"]
    assert {*batch.observations.keys()} == {"policy", "privileged"}


@pytest.mark.parametrize("final", [torch.zeros(ENVS, 3), np.array([None] * ENVS)])
def test_final_observations_of_another_kind_are_refused(final: Any) -> None:
    """As Gymnasium's arrays of objects, which rsl_rl's PPO ignores."""
    with pytest.raises(TypeError, match=r"'final_obs'.* to be a TensorDict .* got a (Tens|ndarr)"):
        collected(make(rsl.CATSPPO), final_obs=final)


@pytest.mark.parametrize(
    ("algorithm", "name"), [(rsl.L2C2PPO, "l2c2_counted"), (rsl.CATSPPO, "cats_counted")]
)
def test_the_share_that_counts_is_less_by_the_resets(algorithm: type[PPO], name: str) -> None:
    """Three of thirty transitions end an episode."""
    ppo = collected(make(algorithm), dones={STEPS - 1: [0, 2], 1: [4]})
    assert update(ppo)[name] == pytest.approx(1 - 3 / (ENVS * STEPS))


def test_final_observations_of_another_shape_are_refused() -> None:
    """They would be broadcast, or of the wrong environments."""
    narrow = observations(77).set("policy", torch.zeros(ENVS, 1))
    for final, found in ((narrow, r"\(6, 1\)"), (observations(77)[:2], r"\(2, 3\)")):
        with pytest.raises(ValueError, match=rf"'final_obs'.*'policy'.* \(6, 3\), got {found}"):
            collected(make(rsl.CATSPPO), final_obs=final)


def test_final_observations_may_be_none() -> None:
    """As if they were not there."""
    absent, without = (
        update(collected(make(rsl.CATSPPO), dones={2: [1]}, **extras))
        for extras in ({"final_obs": None}, {})
    )
    assert absent == without


def test_beside_no_terms_of_the_loss_shares_of_gradients_are_infinite() -> None:
    """rsl_rl computes its own terms elsewhere."""
    ppo = make(rsl.CATSPPO)
    batch = observations(1).set("next", observations(2))
    shares = gradient_shares(CATSLoss(ActorCriticLoss(ppo.actor, ppo.critic)), batch)
    assert shares == {"loss_cats": math.inf}


@pytest.mark.parametrize(
    "name", ["action", "loc", "state_value", "valid", "next", "_row", "nearby"]
)
def test_groups_with_names_that_batches_need_are_refused(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """They would be taken for what they are not."""
    named = observations
    monkeypatch.setattr(f"{__name__}.observations", lambda s: named(s).rename_key_("policy", name))
    monkeypatch.setitem(GROUPS, "actor", [name])
    monkeypatch.setitem(GROUPS, "critic", [name, "privileged"])
    with pytest.raises(ValueError, match=rf"groups .* got \['{name}'\]\. Rename"):
        make(rsl.L2C2PPO, regularizer_cfg={"neighbor_key": ("nearby", "state")})


@pytest.mark.parametrize("algorithm", [rsl.L2C2PPO, rsl.CATSPPO])
def test_an_option_that_there_is_not_is_named_with_those_that_there_are(algorithm: Any) -> None:
    """Not by an error of a class that the user has not named."""
    with pytest.raises(TypeError, match=r"in regularizer_cfg, .*'ramp_updates'.*got \['gane'\]"):
        make(algorithm, regularizer_cfg={"gane": 1.0})


def mirror(env: Any, obs: TensorDict | None, actions: Tensor | None) -> tuple[Any, Any]:
    """Left for right, as rsl_rl's extension asks for it."""
    both_obs = None if obs is None else torch.cat((obs, obs.apply(torch.neg)))
    return both_obs, None if actions is None else torch.cat((actions, -actions))


@pytest.mark.parametrize("augment", [True, False])
def test_a_symmetry_extension_works_as_before(augment: bool) -> None:
    """At no gain it trains as with plain PPO, and at one it leaves the regularizer's term alone."""
    symmetry = {
        "env": None,
        "data_augmentation_func": mirror,
        "use_data_augmentation": augment,
        "use_mirror_loss": True,
        "mirror_loss_coeff": 0.7,
    }
    plain = collected(make(PPO, symmetry_cfg=dict(symmetry)))
    off = {"coeff": 0.0}
    ppo = collected(make(rsl.L2C2PPO, symmetry_cfg=dict(symmetry), regularizer_cfg=off))
    assert update(plain)["symmetry"] == update(ppo)["symmetry"] > 0
    for expected, found in zip(parameters(plain), parameters(ppo), strict=True):
        assert torch.equal(expected, found)

    alone = update(collected(make(rsl.L2C2PPO)))
    beside = update(collected(make(rsl.L2C2PPO, symmetry_cfg=symmetry)))
    assert alone["l2c2_actor"] == beside["l2c2_actor"] > 0


def test_the_gain_rises_with_the_updates_and_is_resumed() -> None:
    """In a line to its end, from where a checkpoint left off, with the same draws of neighbors."""
    # Of one number, as the mean gain depends on the draws otherwise.
    cfg = {"strength": 0.8, "ramp_updates": 4, "lambda_max": 1.00001}
    gains, ppo = [], make(rsl.L2C2PPO, regularizer_cfg=cfg)
    for _ in range(6):
        saved = copy.deepcopy(ppo.save())
        losses = update(collected(ppo))
        gains.append(losses["l2c2_gain"])
    assert gains == pytest.approx([0, 0.2, 0.4, 0.6, 0.8, 0.8], rel=1e-3)

    resumed = make(rsl.L2C2PPO, regularizer_cfg=cfg)
    resumed.load(saved, None, strict=True)
    assert update(collected(resumed)) == losses


def test_a_ramp_of_another_length_is_told_when_it_is_resumed() -> None:
    """The gain would jump: from a half to the whole."""
    ppo = make(rsl.L2C2PPO, max_iterations=4)
    for _ in range(2):
        update(collected(ppo))
    resumed = make(rsl.L2C2PPO, max_iterations=2)
    said = r"with ramp_updates=4, and this run has ramp_updates=2: the gain continues at 1"
    with pytest.warns(UserWarning, match=said):
        resumed.load(ppo.save(), None, strict=True)


def test_draws_of_another_kind_of_device_begin_anew() -> None:
    """A policy trained on a GPU is played, exported and trained on elsewhere."""
    ppo = make(rsl.L2C2PPO, regularizer_cfg={"ramp_updates": 4})
    saved, before = ppo.save(), ppo.regularization.neighbors.generator.get_state()
    saved["regularization_state_dict"] |= {"generator": torch.zeros(16).byte(), "updates": 3}
    ppo.load(saved, None, strict=True)
    assert ppo.regularization.updates == 3
    assert ppo.regularization.neighbors.generator.get_state().equal(before)


def test_only_the_first_of_several_processes_draws_as_it_did() -> None:
    """It is the one that saves, and the others would all draw its numbers."""
    saved = update_and_save(make(rsl.L2C2PPO))
    for rank, same in ((0, True), (1, False)):
        ppo = make(rsl.L2C2PPO)
        ppo.is_multi_gpu, ppo.gpu_global_rank = True, rank
        ppo.load(copy.deepcopy(saved), None, strict=True)
        drawn = ppo.regularization.neighbors.generator.get_state()
        assert drawn.equal(saved["regularization_state_dict"]["generator"]) == same
        assert ppo.regularization.updates == 1


def update_and_save(ppo: PPO) -> dict[str, Any]:
    update(collected(ppo))
    return copy.deepcopy(ppo.save())


class OwnMemory(MLPModel):
    is_recurrent = True


ENDS = {1: [0, 2], 3: [1]}
MEMORIES = pytest.mark.parametrize(
    "memory", [("lstm", "gru"), ("gru", None), (None, "lstm")], ids=str
)


def latents(model: MLPModel, groups: list[str], at: TensorDict | None = None) -> Tensor:
    """What the last layers read at every step, ``[STEPS * ENVS, width]``, by torch's own layers.

    ``at``: other observations ``[STEPS * ENVS]`` at which single steps are taken.
    """
    states: Any = None
    found = []
    for step in range(STEPS):
        rows = slice(step * ENVS, (step + 1) * ENVS)
        there = observations(step) if at is None else at[rows]
        here, there = (
            model.obs_normalizer(torch.cat([obs[group] for group in groups], -1))
            for obs in (observations(step), there)
        )
        if not model.is_recurrent:
            found.append(there)
            continue
        found.append(model.rnn.rnn(there[None], states)[0].squeeze(0))
        _, states = model.rnn.rnn(here[None], states)
        kept = torch.ones(1, ENVS, 1)
        kept[:, ENDS.get(step, [])] = 0.0
        lstm = isinstance(states, tuple)
        states = tuple(state * kept for state in states) if lstm else states * kept
    return torch.cat(found)


@MEMORIES
def test_recurrent_models_take_single_steps(memory: tuple[str | None, str | None]) -> None:
    """The terms are those of the layers, stepped through the episodes and once to each neighbor."""
    ppo = collected(make(rsl.L2C2PPO, memory=memory, regularizer_cfg={"beta": 0.5}), ENDS)
    near, transform = Neighborhood(1.0, 1.0, 100.0, neighbors="line"), ppo.regularization.neighbors
    drawn = transform.generator.get_state()
    batch = transform(transitions(torch.arange(STEPS * ENVS)))
    transform.generator.set_state(drawn)
    neighbors = batch["neighbor"].exclude("distance").apply(lambda value: value.squeeze(1))
    gain = near.gain(batch["neighbor", "distance"].squeeze(1))
    counts = torch.ones(STEPS, ENVS)
    for step, ended in ENDS.items():
        counts[step, ended] = 0.0
    weights = gain * counts.flatten() / counts.sum()
    expected = []
    for model, groups, factor in (
        (ppo.actor, GROUPS["actor"], 1.0),
        (ppo.critic, GROUPS["critic"], 0.5 * 0.5),  # beta, and half the squared difference
    ):
        here, there = (model.mlp(latents(model, groups, at)) for at in (None, neighbors))
        difference = (here - there)[:, :ACTIONS].square().mean(-1)
        expected.append(factor * (weights * difference).sum().item())
    losses = update(ppo)
    assert (losses["l2c2_actor"], losses["l2c2_critic"]) == pytest.approx(expected, rel=1e-4)
    assert losses["l2c2_counted"] == pytest.approx(counts.mean().item())


@MEMORIES
def test_recurrent_models_learn_as_before_without_a_gain(
    memory: tuple[str | None, str | None],
) -> None:
    plain, ppo = (collected(make(one, memory=memory), ENDS) for one in (PPO, rsl.L2C2PPO))
    ppo.regularization.loss.regularizer_gain = 0.0
    smoothed = collected(make(rsl.L2C2PPO, memory=memory), ENDS)
    (expected, _), (without, _), (with_term, _) = map(steps, (plain, ppo, smoothed))
    for a, b in zip(without, expected, strict=True):
        torch.testing.assert_close(a, b)
    assert any(not torch.allclose(a, b) for a, b in zip(with_term, expected, strict=True))
    again = collected(ppo)  # The next rollout begins in the middle of episodes.
    assert update(again)["l2c2_counted"] == 1.0


@pytest.mark.parametrize("before", [PPO, rsl.CATSPPO], ids=["plain", "another regularizer"])
def test_a_checkpoint_of_another_ppo_is_a_beginning(before: type[PPO]) -> None:
    """Its networks are taken, and the ramp begins."""
    ppo = make(rsl.L2C2PPO, regularizer_cfg={"ramp_updates": 4})
    other = make(before)
    update(collected(other))
    ppo.load(other.save(), None, strict=True)
    assert update(collected(ppo))["l2c2_actor"] == 0


@pytest.mark.parametrize(
    "settings, said",
    [
        ({"model": OwnMemory}, "the actor is recurrent and of .* .OwnMemory.*Take an RNNModel"),
        ({"memory": ("gru", None), "regularizer_cfg": {"method": "cats"}}, "cats compares .* l2c2"),
        ({"normal": {"class_name": "BetaDistribution"}}, "normal .* got a BetaDistribution"),
        ({"normal": None}, "normal .* got a NoneType"),
        ({"regularizer_cfg": {"sigmaa": 1.0}}, "sigmaa"),
        ({"regularizer_cfg": "strength=2"}, "regularizer_cfg to be a dict .* got 'strength=2'"),
        ({"regularizer_cfg": {"method": ["l2c2"]}}, r"method must be 'l2c2' or .* got \['l2c2'\]"),
        ({"max_iterations": 1500.0}, "max_iterations must be an integer, got 1500.0"),
    ],
)
def test_what_cannot_be_regularized_is_refused(settings: dict[str, Any], said: str) -> None:
    """With what was given and what to do."""
    with pytest.raises(TypeError, match=said):
        make(rsl.RegularizedPPO if "memory" in settings else rsl.L2C2PPO, **settings)


def test_the_groups_that_move_can_be_chosen() -> None:
    """Of what the critic reads only that which the actor reads, too; the actor has to be moved."""
    cfg: dict[str, Any] = {"moved_keys": ["policy"], "neighbor_key": "near", "beta": 0.5}
    ppo = make(rsl.L2C2PPO, regularizer_cfg=cfg)
    assert ppo.regularization.neighbors.in_keys == ["policy"]
    assert ppo.regularization.neighbors.out_key == "near"
    assert update(collected(ppo))["l2c2_critic"] > 0
    with pytest.raises(ValueError, match=r"privileged.*, but actor_network reads only .*policy"):
        make(rsl.L2C2PPO, regularizer_cfg={"moved_keys": ["privileged"], "beta": 0.5})
    with pytest.raises(ValueError, match=r"names \['nonsense'\], .*'policy', 'privileged'"):
        make(rsl.L2C2PPO, regularizer_cfg={"moved_keys": ["nonsense"], "beta": 0.5})


def test_commands_can_stay_still_with_cats(monkeypatch: pytest.MonkeyPatch) -> None:
    """The chosen groups are taken from the next state."""
    monkeypatch.setitem(GROUPS, "actor", ["policy", "privileged"])
    terms = []
    for keys in ({}, {"moved_keys": ["policy"]}, {"moved_keys": ["privileged"]}):
        ppo = make(rsl.RegularizedPPO, regularizer_cfg={"method": "cats", **keys})
        terms.append(update(collected(ppo))["cats"])
    assert terms[0] > max(terms[1:]) > min(terms[1:]) > 0


EXAMPLE = Path(__file__).parents[1] / "examples" / "rsl_rl_l2c2.py"


def runner_config(**algorithm: Any) -> dict[str, Any]:
    """A small runner's; new each time, as rsl_rl 5.4 takes names of classes out of it."""
    network = {"class_name": "MLPModel", "hidden_dims": [8]}
    return {
        "algorithm": {"class_name": "torchrl_l2c2.rsl_rl:L2C2PPO", **algorithm},
        "actor": {**network, "distribution_cfg": dict(NORMAL)},
        "critic": dict(network),
        "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
        "num_steps_per_env": 4,
        "save_interval": 1,
    }


def test_the_pages_configuration_builds(monkeypatch: pytest.MonkeyPatch) -> None:
    """As it stands there, on any task, with the preset of PPO and its ramp."""
    monkeypatch.syspath_prepend(EXAMPLE.parent)
    from rsl_rl.runners import OnPolicyRunner
    from rsl_rl_points import NoisyPoints

    page = (EXAMPLE.parents[1] / "docs" / "rsl_rl.md").read_text()
    told: dict[str, Any] = {}
    exec(re.search(r"^```python\n(.*?)^```", page, re.M | re.S)[1], told)
    regularization = OnPolicyRunner(NoisyPoints(2), told["config"]).alg.regularization
    assert regularization.ramp_updates == 1500
    chosen = dict(preset("l2c2", "ppo").settings)
    near = regularization.loss.l2c2_neighborhood
    for name in ("neighbors", "lambda_min", "lambda_max"):
        assert getattr(near, name) == chosen.pop(name)
    assert regularization.loss.l2c2_policy_distance == chosen.pop("policy_distance")
    assert chosen == {"beta": 0.0} and regularization.loss.added_terms == {"loss_l2c2_actor"}


@pytest.mark.parametrize("kind", ["MLPModel", "RNNModel"])
def test_the_pages_recording_is_one_episode_of_mean_actions(
    kind: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """With a name for each action, up to the first reset, whatever the policy saw before."""
    monkeypatch.syspath_prepend(EXAMPLE.parent)
    from rsl_rl.runners import OnPolicyRunner
    from rsl_rl_points import NoisyPoints

    page = (EXAMPLE.parents[1] / "docs" / "rsl_rl.md").read_text()
    told: dict[str, Any] = {}
    exec(re.findall(r"^```python\n(.*?)^```", page, re.M | re.S)[2], told)
    config = runner_config()
    if kind == "RNNModel":
        config["actor"] |= {"class_name": kind, "rnn_type": "gru", "rnn_hidden_dim": 8}
    policy = OnPolicyRunner(NoisyPoints(2), config).get_inference_policy()
    path, tables = tmp_path / "sim.csv", []
    for _ in range(2):
        torch.manual_seed(0)
        env = NoisyPoints(2)
        policy.reset()
        first = policy(env.get_observations())[0].tolist()
        told["record"](policy, env, path, dt=0.1, steps=1000)
        header, *rows = path.read_text().splitlines()
        tables.append([[float(cell) for cell in row.split(",")] for row in rows])
    assert header == "time,action0" and 4 < len(rows) < 1000
    assert tables[0][0] == pytest.approx([0.0, *first])
    assert tables[0] == tables[1] and tables[0][3][0] == pytest.approx(0.3)


def test_the_runners_iterations_are_the_ramp(monkeypatch: pytest.MonkeyPatch) -> None:
    """Isaac Lab and mjlab have them in the runner's configuration, which stays as it was."""
    monkeypatch.syspath_prepend(EXAMPLE.parent)
    from rsl_rl.runners import OnPolicyRunner
    from rsl_rl_points import NoisyPoints

    config = {**runner_config(), "max_iterations": 20}
    runner = OnPolicyRunner(NoisyPoints(2), config)
    assert runner.alg.regularization.ramp_updates == 20
    assert runner.cfg["obs_groups"] == {"actor": ["policy"], "critic": ["policy"]}
    assert "max_iterations" not in config["algorithm"] and config["max_iterations"] == 20


def test_a_setting_beside_the_class_name_is_told_its_place() -> None:
    """rsl_rl's own message does not name it."""
    with pytest.raises(TypeError, match=r"write \{'regularizer_cfg': \{'strength': 2.0\}\}"):
        make(rsl.L2C2PPO, strength=2.0)


def test_a_misspelled_argument_is_told_its_name() -> None:
    """It is no setting of the regularizer, as ``beta`` is none of CATS."""
    with pytest.raises(TypeError, match="Did you mean 'learning_rate'"):
        make(rsl.L2C2PPO, learning_rat=2.0)
    with pytest.raises(TypeError, match=r"It has .*'learning_rate'"):
        make(rsl.CATSPPO, beta=1.0)


def test_settings_beside_the_algorithm_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """rsl_rl would train without them."""
    monkeypatch.syspath_prepend(EXAMPLE.parent)
    from rsl_rl.runners import OnPolicyRunner
    from rsl_rl_points import NoisyPoints

    config = {**runner_config(), "regularizer_cfg": {"strength": 2.0}}
    with pytest.raises(ValueError, match="regularizer_cfg in the algorithm's configuration, got"):
        OnPolicyRunner(NoisyPoints(2), config)


def test_a_teacher_that_was_trained_with_it_is_distilled(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """By rsl_rl's own Distillation, which loads the checkpoint."""
    monkeypatch.syspath_prepend(EXAMPLE.parent)
    from rsl_rl.runners import DistillationRunner, OnPolicyRunner
    from rsl_rl_points import NoisyPoints

    runner = OnPolicyRunner(NoisyPoints(2), runner_config())
    torch.save(runner.alg.save() | {"iter": 0, "infos": None}, path := tmp_path / "model.pt")
    config = runner_config()
    network = config.pop("actor")
    del config["critic"]
    # The runner takes entries out of them.
    config |= {"student": network, "teacher": copy.deepcopy(network)}
    config |= {"algorithm": {"class_name": "Distillation"}}
    config["obs_groups"] = {"student": ["policy"], "teacher": ["policy"]}
    distilled = DistillationRunner(NoisyPoints(2), config)
    distilled.load(str(path))
    trained, loaded = (part.state_dict() for part in (runner.alg.actor, distilled.alg.teacher))
    assert trained.keys() == loaded.keys()
    assert all(torch.equal(weight, loaded[name]) for name, weight in trained.items())


def test_what_neighbors_cannot_move_in_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before rsl_rl's message, or one with names that its users do not write."""
    monkeypatch.syspath_prepend(EXAMPLE.parent)
    from rsl_rl.runners import DistillationRunner, OnPolicyRunner
    from rsl_rl_points import NoisyPoints

    class Flagged(NoisyPoints):
        def get_observations(self) -> TensorDict:
            seen: TensorDict = super().get_observations()
            return seen.set("flag", torch.ones(self.num_envs, 1, dtype=torch.long))

    config = {**runner_config(), "obs_groups": {"actor": ["flag"], "critic": ["policy"]}}
    with pytest.raises(TypeError, match=r"of floating-point numbers among \['flag'\]"):
        OnPolicyRunner(Flagged(2), config)
    config = runner_config()
    config |= {"student": config.pop("actor"), "teacher": config.pop("critic")}
    config["obs_groups"] = {"student": ["policy"], "teacher": ["policy"]}
    with pytest.raises(ValueError, match=r"an actor and a critic, got .*'student', 'teacher'\]"):
        DistillationRunner(NoisyPoints(2), config)


def test_the_runner_builds_it_by_its_name(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """With its settings, from a configuration; its terms are logged, and its state is saved."""
    monkeypatch.syspath_prepend(EXAMPLE.parent)
    from rsl_rl.runners import OnPolicyRunner
    from rsl_rl_points import NoisyPoints

    cfg = {"sigma": 0.5, "lambda_max": 3.0, "beta": 0.25, "policy_distance": "kl"}
    config = runner_config(regularizer_cfg=cfg)
    # rsl_rl 5.4 takes the names of classes out of what it is given.
    runner = OnPolicyRunner(NoisyPoints(8), copy.deepcopy(config), log_dir=str(tmp_path))
    loss = runner.alg.regularization.loss
    assert isinstance(runner.alg, rsl.L2C2PPO)
    near = Neighborhood(0.5, lambda_min=1.0, lambda_max=3.0, neighbors="line")
    assert (loss.l2c2_neighborhood, loss.l2c2_beta) == (near, 0.25)
    logged = []
    monkeypatch.setattr(runner.logger, "log", lambda **told: logged.append(told["loss_dict"]))
    runner.learn(2)
    assert logged[1].keys() >= {"surrogate", "l2c2_actor", "l2c2_critic", "l2c2_kl", "l2c2_gain"}
    assert logged[1]["l2c2_actor"] > 0

    again = OnPolicyRunner(NoisyPoints(8), runner_config(regularizer_cfg=cfg))
    again.load(str(tmp_path / "model_1.pt"))
    assert again.alg.regularization.updates == 2


def test_the_example_trains_and_compares(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It prints a table of numbers with their intervals, and can be read in one go."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(EXAMPLE.parent)
    monkeypatch.setattr(sys, "argv", [str(EXAMPLE)])
    with torch.random.fork_rng():
        runpy.run_path(str(EXAMPLE), run_name="__main__")
    cell = r"(-?[0-9.]+) ± ([0-9.]+)"
    rows = re.findall(rf"^\| (.+) \| {cell} \| {cell} \|$", capsys.readouterr().out, re.M)
    plain, regularized, difference = [[float(cell) for cell in row[1:]] for row in rows]
    for column in (0, 2):
        assert difference[column] == pytest.approx(regularized[column] - plain[column], abs=2e-3)
    for script in (EXAMPLE, EXAMPLE.with_stem("rsl_rl_points")):
        assert len(script.read_text().splitlines()) < 80


def test_gymnasium_for_rsl_rl_is_what_gymnasium_plays(monkeypatch: pytest.MonkeyPatch) -> None:
    """Clipped actions, the first observation after an end, and ends by the time limit apart."""
    pytest.importorskip("mujoco")
    monkeypatch.syspath_prepend(EXAMPLE.parent)
    from rsl_rl_gymnasium import GymnasiumEnv

    env, actions = GymnasiumEnv("Hopper-v5", 2, seed=3), 5.0 * torch.randn(60, 2, 3)
    alone = [gymnasium.make("Hopper-v5") for _ in range(2)]
    seen = [each.reset(seed=3 + i)[0] for i, each in enumerate(alone)]
    ended, lengths = 0, [0, 0]
    for each in actions:
        torch.testing.assert_close(
            env.get_observations()["policy"], torch.tensor(np.stack(seen)).float()
        )
        _, rewards, dones, extras = env.step(each)
        for i, task in enumerate(alone):
            seen[i], reward, terminated, _, _ = task.step(each[i].clamp(-1, 1).numpy())
            assert rewards[i].item() == pytest.approx(reward)
            assert dones[i] == terminated and not extras["time_outs"][i]
            ended, lengths[i] = ended + terminated, 0 if terminated else lengths[i] + 1
            if terminated:
                seen[i] = task.reset()[0]
        assert env.episode_length_buf.tolist() == lengths
    assert ended > 0
    late = GymnasiumEnv("Pendulum-v1", 2, seed=0)
    for step in range(200):
        _, _, dones, extras = late.step(torch.zeros(2, 1))
        assert (dones == (step == 199)).all() and (extras["time_outs"] == dones).all()


def test_the_gymnasium_example_trains(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """For an iteration, on any task."""
    script = EXAMPLE.with_stem("rsl_rl_gymnasium")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(EXAMPLE.parent)
    monkeypatch.setattr(sys, "argv", [str(script), "Pendulum-v1", "1"])
    with torch.random.fork_rng():
        runpy.run_path(str(script), run_name="__main__")
    printed = capsys.readouterr().out
    assert re.search(r"^Pendulum-v1 with L2C2: return -\d+.\d, action variation 0", printed, re.M)
    assert len(script.read_text().splitlines()) < 80


def trained_runner(folder: Path, algorithm: dict[str, Any], **runner: Any) -> Any:
    """A runner after two iterations, which have moved the normalization of the observations."""
    from rsl_rl.runners import OnPolicyRunner
    from rsl_rl_points import NoisyPoints

    torch.manual_seed(0)
    config = {**runner_config(**algorithm), **runner}
    for network in ("actor", "critic"):
        config[network]["obs_normalization"] = True
    trained = OnPolicyRunner(NoisyPoints(8), config, log_dir=str(folder))
    trained.learn(2)
    return trained


EXPORTED: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "float32": ({}, {}),
    "mixed precision": ({"use_mixed_precision": True}, {}),
    "compiled": ({}, {"torch_compile_mode": "default"}),
}


@pytest.mark.parametrize(
    "name",
    ["float32", "mixed precision", pytest.param("compiled", marks=pytest.mark.slow)],
)
def test_the_runners_exports_give_the_actions_of_its_policy(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As TorchScript and as ONNX, with the normalization of the observations."""
    runtime = pytest.importorskip("onnxruntime")
    monkeypatch.syspath_prepend(EXAMPLE.parent)
    algorithm, options = EXPORTED[name]
    if not algorithm.keys() <= inspect.signature(PPO).parameters.keys():
        pytest.skip("this version of rsl_rl has no mixed precision")
    runner = trained_runner(
        tmp_path, {"regularizer_cfg": {"strength": 3.0}, **algorithm}, **options
    )
    runner.export_policy_to_jit(str(tmp_path))
    runner.export_policy_to_onnx(str(tmp_path))

    observed = TensorDict({"policy": 3 * torch.randn(5, 2) + 1}, [5])
    with torch.inference_mode():
        expected = runner.get_inference_policy()(observed)
        jit = torch.jit.load(tmp_path / "policy.pt")(observed["policy"])
    torch.testing.assert_close(jit, expected)
    session = runtime.InferenceSession(str(tmp_path / "policy.onnx"))
    for row, action in zip(observed["policy"], expected, strict=True):
        (found,) = session.run(["actions"], {"obs": row[None].numpy()})
        torch.testing.assert_close(torch.as_tensor(found[0]), action, rtol=1e-4, atol=1e-5)


def test_a_checkpoint_loads_into_rsl_rls_own_ppo(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Strictly, with the same actions: playing a policy does not need this package."""
    monkeypatch.syspath_prepend(EXAMPLE.parent)
    runner = trained_runner(tmp_path / "l2c2", {})
    plain = trained_runner(tmp_path / "plain", {"class_name": "PPO"})
    observed = TensorDict({"policy": torch.randn(5, 2)}, [5])
    with torch.inference_mode():
        expected, before = (each.get_inference_policy()(observed) for each in (runner, plain))
        plain.load(str(tmp_path / "l2c2" / "model_1.pt"), strict=True)
        found = plain.get_inference_policy()(observed)
    assert torch.equal(found, expected) and not torch.equal(before, expected)


def test_an_rsl_rl_that_is_too_old_is_refused_with_the_version_needed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Version 5.0.1, which an Isaac Lab pins, has no such extension."""
    monkeypatch.delattr("rsl_rl.extensions.Symmetry")
    monkeypatch.setattr("importlib.metadata.version", lambda name: "5.0.1")
    said = r"Expected rsl-rl-lib 5\.4\.1 or newer.*, got 5\.0\.1\. Run: pip install [^\n]*$"
    with pytest.raises(ImportError, match=said):
        importlib.reload(rsl)
