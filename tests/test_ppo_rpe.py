"""PPO-RPE against hand-computed numbers, its stationary point, and the rules of a TorchRL loss."""

import copy
import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import ExplorationType, set_exploration_type
from torchrl.modules import IndependentNormal, NormalParamExtractor, ProbabilisticActor

from torchrl_l2c2 import (
    CAPSLoss,
    CATSLoss,
    L2C2Loss,
    PPORPELoss,
    TSoftUpdate,
    make_actor,
    make_critic,
)
from torchrl_l2c2.objectives.ppo_rpe import (
    actor_loss,
    critic_loss,
    of_each_transition,
    penalty_gain,
    relative_density_ratio,
    update_deviation,
)


def test_the_relative_density_ratio():
    """rho / (3/4 + rho / 4): 0, 1, 4/3 and, at infinity, 4."""
    found = relative_density_ratio(torch.tensor([0.0, 1.0, 1.5, 1e9]), beta=0.25)
    assert found.tolist() == pytest.approx([0.0, 1.0, 4 / 3, 4.0])


def test_the_gain_of_the_penalty():
    """beta = 1/4, epsilon = .4: |A| / (.4 (.75 -+ .05)), with the sign of A."""
    found = penalty_gain(torch.tensor([2.1, -1.6, 0.0]), torch.tensor(0.4), beta=0.25)
    assert found.tolist() == pytest.approx([2.1 / 0.28, 1.6 / 0.32, 0.0])


def test_the_actors_loss():
    """A = 2.1, rho = 1.5: C / 2 * 1.125 * (1/3)^2 - 3.15; at rho = 1 it is -A."""
    advantage, ratio = torch.tensor([2.1, 2.1]), torch.tensor([1.5, 1.0])
    found = actor_loss(advantage, ratio, torch.tensor(0.4), beta=0.25)
    expected = [2.1 / 0.28 / 2 * 1.125 / 9 - 3.15, -2.1]
    assert found.tolist() == pytest.approx(expected)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_actors_loss_is_stationary_at_the_threshold(sign):
    """Where rho_R = 1 + sgn(A) epsilon its derivative by rho is 0."""
    beta, epsilon = 0.3, 0.2
    relative = 1 + sign * epsilon
    ratio = torch.tensor((1 - beta) * relative / (1 - beta * relative), dtype=torch.float64)
    ratio.requires_grad_()
    advantage = torch.tensor(1.7 * sign, dtype=torch.float64)
    loss = actor_loss(advantage, ratio, torch.tensor(epsilon, dtype=torch.float64), beta)
    (slope,) = torch.autograd.grad(loss, ratio)
    assert slope.item() == pytest.approx(0.0, abs=1e-12)


def test_the_critics_loss():
    """Half the sum of squared errors of the heads: (1 + 4) / 2 and 9 / 2."""
    found = critic_loss(torch.tensor([[1.0], [3.0]]), torch.tensor([[0.0, 3.0], [3.0, 0.0]]))
    assert found.tolist() == [2.5, 4.5]


@pytest.mark.parametrize(
    ("statistic", "deviation", "updated"),
    [("max", 0.8, 0.8), ("ema", 0.5, 0.9 * 0.6 + 0.1 * 0.5)],
)
def test_the_deviation_is_a_decaying_maximum_or_an_average(statistic, deviation, updated):
    """Of |rho_R - 1| = .2 and .8, after Delta = .6."""
    found = update_deviation(
        torch.tensor(0.6), torch.tensor([0.8, 1.8]), decay=0.9, floor=0.1, statistic=statistic
    )
    assert [x.item() for x in found] == pytest.approx([deviation, updated])


def test_the_deviation_decays_to_its_floor_and_forgets_nan():
    """Equal policies: decay * Delta, and not below; NaN counts as no deviation."""
    settings = {"decay": 0.5, "floor": 0.1, "statistic": "max"}
    same = torch.tensor([1.0, math.nan])
    assert update_deviation(torch.tensor(0.6), same, **settings)[1].item() == pytest.approx(0.3)
    assert update_deviation(torch.tensor(0.15), same, **settings)[1].item() == pytest.approx(0.1)


class Heads(nn.Module):
    """A critic whose two heads are known: V(s) = (s, 3 s), so the mean is 2 s."""

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.tensor([1.0, 3.0]))

    def forward(self, observation):
        heads = observation * self.weight
        return heads.mean(-1, keepdim=True), heads


def make_loss(**settings):
    network = nn.Sequential(nn.Linear(1, 2), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(network, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    critic = TensorDictModule(Heads(), ["observation"], ["state_value", "state_value_heads"])
    return PPORPELoss(actor, critic, **{"critic_weighting": "ratio", **settings})


def make_batch(loss, ratios, rewards, observations=None, next_observations=None, terminated=None):
    """A batch on which the likelihood ratio of every transition is the given one."""
    count = len(ratios)
    observation = torch.tensor(observations or [0.5] * count).view(-1, 1)
    batch = TensorDict(
        {
            "observation": observation,
            "action": torch.linspace(-0.5, 0.5, count).view(-1, 1),
            "next": {
                "observation": torch.tensor(next_observations or [0.25] * count).view(-1, 1),
                "reward": torch.tensor(rewards).view(-1, 1),
                "terminated": torch.tensor(terminated or [False] * count).view(-1, 1),
                "done": torch.tensor(terminated or [False] * count).view(-1, 1),
            },
        },
        [count],
    )
    with torch.no_grad(), loss.actor_network_params.to_module(loss.actor_network):
        log_prob = loss.actor_network.get_dist(batch.clone()).log_prob(batch["action"])
    batch["action_log_prob"] = log_prob - torch.tensor(ratios).log()
    return batch


def test_both_losses_equal_hand_computed_numbers():
    """One transition: y = .2 + .5 * .5 = .45, V = 1, A = -.55; rho = 2, so rho_R = 4/3."""
    loss = make_loss(gamma=0.5, delta_min=0.1)
    batch = make_batch(loss, [2.0], [0.2])
    terms = loss(batch)
    deviation = 1 / 3
    threshold = 0.5 * deviation
    gain = 0.55 / (threshold * (0.5 + 0.5 * threshold / 2))
    expected = 0.55 * 2.0 + gain * 0.5 * 1.5 * deviation**2
    assert terms["ratio_deviation"].item() == pytest.approx(deviation, rel=1e-5)
    assert terms["ratio_threshold"].item() == pytest.approx(threshold, rel=1e-5)
    assert terms["loss_actor"].item() == pytest.approx(expected, rel=1e-4)
    squares = (0.45 - 0.5) ** 2 + (0.45 - 1.5) ** 2
    assert terms["loss_critic"].item() == pytest.approx(0.5 * squares * 4 / 3, rel=1e-5)
    assert batch["td_error"].tolist() == pytest.approx([0.55])


def test_without_critic_weighting_the_value_loss_does_not_see_the_ratio():
    """critic_weighting='none' leaves half the sum of squared errors of the heads."""
    loss = make_loss(gamma=0.5, critic_weighting="none")
    terms = loss(make_batch(loss, [2.0], [0.2]))
    squares = (0.45 - 0.5) ** 2 + (0.45 - 1.5) ** 2
    assert terms["loss_critic"].item() == pytest.approx(0.5 * squares, rel=1e-5)


def test_termination_stops_the_bootstrap():
    """y is the reward alone where the episode terminated."""
    loss = make_loss(gamma=0.5)
    batch = make_batch(loss, [1.0, 1.0], [0.2, 0.2], terminated=[False, True])
    loss(batch)
    assert batch["td_error"].tolist() == pytest.approx([abs(0.45 - 1.0), abs(0.2 - 1.0)])


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("beta", [0.3, 0.5, 0.7])
def test_the_loss_is_stationary_where_the_relative_ratio_meets_the_threshold(sign, beta):
    """d/d rho (-A rho + C g(rho)) = 0 at rho_R = 1 + sgn(A) * threshold, and not beside it."""
    epsilon = 0.2
    relative = 1 + sign * epsilon
    ratio = (1 - beta) * relative / (1 - beta * relative)
    reward = 0.75 + sign * 0.6

    def gradient(rho):
        loss = make_loss(gamma=0.5, kappa=0.4, beta=beta, delta_min=0.5)
        terms = loss(make_batch(loss, [rho], [reward]))
        assert terms["ratio_threshold"].item() == pytest.approx(epsilon)
        terms["loss_actor"].backward()
        return max(
            p.grad.abs().max().item() for p in loss.actor_network_params.flatten_keys().values()
        )

    assert gradient(ratio) < 1e-5
    assert gradient(ratio * 1.1) > 1e-3
    assert gradient(ratio / 1.1) > 1e-3


def test_the_threshold_decays_and_jumps_with_the_largest_deviation():
    """Delta = max(delta_min, decay * Delta, max |rho_R - 1|), batch after batch."""
    loss = make_loss(decay=0.9, delta_min=0.1, kappa=0.5)
    far, near = make_batch(loss, [1.0, 3.0], [0.0, 0.0]), make_batch(loss, [1.0], [0.0])
    seen = [loss(batch)["ratio_threshold"].item() for batch in (far, near, near)]
    assert seen == pytest.approx([0.25, 0.225, 0.2025], rel=1e-5)
    for _ in range(30):
        last = loss(near)["ratio_threshold"].item()
    assert last == pytest.approx(0.05)


def test_the_ema_reading_averages_the_mean_deviation():
    """threshold='ema': Delta <- decay * Delta + (1 - decay) * mean |rho_R - 1|."""
    loss = make_loss(decay=0.5, delta_min=0.1, kappa=0.5, threshold="ema")
    terms = loss(make_batch(loss, [1.0, 3.0], [0.0, 0.0]))
    assert terms["ratio_threshold"].item() == pytest.approx(0.5 * (0.5 * 0.1 + 0.5 * 0.25))


@pytest.mark.parametrize("threshold", ["max", "ema"])
@pytest.mark.parametrize("importance", ["max", "mean"])
def test_masked_transitions_have_no_part_in_anything(importance, threshold):
    """The numbers, and what is kept for later batches, are those of the batch without them."""
    settings = {"importance": importance, "threshold": threshold, "decay": 0.5}
    found = []
    for count in (3, 5):
        loss = make_loss(**settings)
        ratios, rewards = [1.5, 0.7, 1.1, 50.0, 0.1], [0.3, -2.0, 1.0, 9.0, 9.0]
        batch = make_batch(make_loss(**settings), ratios, rewards)[:count]
        batch["action_log_prob"][:] = make_batch(loss, ratios, rewards)["action_log_prob"][:count]
        batch["priority_weight"] = torch.tensor([2.0, 1.0, 0.5, 8.0, 9.0])[:count]
        batch["collector", "mask"] = torch.arange(count) < 3
        found.append({**loss(batch), "delta": loss.delta})
    for key, expected in found[0].items():
        torch.testing.assert_close(found[1][key], expected, msg=key)


@pytest.mark.parametrize("importance", ["max", "mean"])
def test_a_batch_that_is_masked_as_a_whole_trains_nothing(importance):
    """Its weights have no largest: the gradient was NaN behind a loss of 0."""
    loss = make_loss(importance=importance)
    batch = make_batch(loss, [1.5, 0.7], [0.3, -2.0])
    batch["priority_weight"] = torch.tensor([2.0, 1.0])
    batch["collector", "mask"] = torch.zeros(2, dtype=torch.bool)
    terms = loss(batch)
    sum(terms[key] for key in ("loss_actor", "loss_critic")).backward()
    gradients = [p.grad for p in loss.parameters() if p.grad is not None]
    assert gradients and all(not gradient.any() for gradient in gradients)


def test_a_likelihood_of_each_action_is_no_likelihood():
    """Of one action it is the same in another shape; of several it is refused, with what to do."""
    base, found = make_loss(), []
    batch = make_batch(base, [1.5, 0.7], [0.3, -2.0])
    for distribution in (IndependentNormal, torch.distributions.Normal):
        loss, own = copy.deepcopy(base), batch.clone()
        loss.actor_network[-1].distribution_class = distribution
        if distribution is torch.distributions.Normal:
            own["action_log_prob"] = own["action_log_prob"].unsqueeze(-1)
        found.append(loss(own))
    for key in ("loss_actor", "loss_critic", "ratio_threshold"):
        torch.testing.assert_close(found[1][key], found[0][key])
    with pytest.raises(ValueError, match=r"shape \(2,\) in this batch, got \(2, 3\): use a"):
        of_each_transition(torch.zeros(2, 3), torch.Size([2]))


def test_the_stored_likelihood_has_one_number_per_transition():
    """With a last dimension of 1 it is the same; with more, the error names the batch's entry."""
    loss = make_loss()
    batch = make_batch(loss, [1.5, 0.7], [0.3, -2.0])
    expected, own = copy.deepcopy(loss)(batch.clone()), batch.clone()
    own["action_log_prob"] = own["action_log_prob"].unsqueeze(-1)
    torch.testing.assert_close(loss(own)["loss_actor"], expected["loss_actor"])
    own["action_log_prob"] = own["action_log_prob"].expand(2, 3)
    with pytest.raises(ValueError, match=r"the batch's 'action_log_prob' must be one number"):
        loss(own)


@pytest.mark.parametrize(("importance", "weights"), [("max", (1.0, 0.5)), ("mean", (4 / 3, 2 / 3))])
def test_priority_weights_are_divided_by_their_largest_or_their_mean(importance, weights):
    """Weights (2, 1): the first only scales down, the second is a weighted mean."""
    settings = {"ratios": [1.5, 0.7], "rewards": [0.3, -2.0]}
    plain = make_loss(reduction="none")
    each = plain(make_batch(plain, **settings))
    weighted = make_loss(importance=importance)
    weighted.load_state_dict({**plain.state_dict(), "delta": torch.tensor(0.1)})
    batch = make_batch(weighted, **settings)
    batch["priority_weight"] = torch.tensor([2.0, 1.0])
    terms = weighted(batch)
    for key in ("loss_actor", "loss_critic"):
        expected = (weights[0] * each[key][0] + weights[1] * each[key][1]) / 2
        torch.testing.assert_close(terms[key], expected)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("wrap", [L2C2Loss, CAPSLoss])
def test_a_sum_is_the_mean_times_the_transitions_that_count(wrap, masked):
    """With priority weights: of its own terms, which they scale down, and a regularizer's."""
    found = {}
    for reduction in ("mean", "sum", "none"):
        torch.manual_seed(0)
        loss = wrap(make_loss(reduction=reduction))
        batch = make_batch(loss, ratios=[1.5, 0.7, 1.1], rewards=[0.3, -2.0, 1.0])
        batch["next", "observation"] = batch["observation"] + torch.tensor([[0.1], [0.2], [0.4]])
        batch["priority_weight"] = torch.tensor([2.0, 0.1, 0.5])
        if masked:
            batch["collector", "mask"] = torch.tensor([True, True, False])
        terms = loss(batch)
        found[reduction] = {k: v for k, v in terms.items() if k.startswith("loss_")}
    assert len(found["sum"]) > 2
    for key, mean in found["mean"].items():
        count = 2 if masked else 3
        torch.testing.assert_close(found["sum"][key], count * mean, rtol=1e-5, atol=0)
        torch.testing.assert_close(found["none"][key].sum(), count * mean, rtol=1e-5, atol=0)


def test_the_target_baseline_takes_the_ratio_to_the_target_policy():
    """baseline='target' needs no stored likelihood; target and policy start equal: ratio 1."""
    loss = make_loss(baseline="target")
    batch = make_batch(loss, [5.0], [0.0])
    del batch["action_log_prob"]
    assert "action_log_prob" not in loss.in_keys
    assert loss(batch)["ratio_deviation"].item() == pytest.approx(0.0, abs=1e-6)


def test_extreme_ratios_stay_finite():
    """Stored likelihoods hundreds of nats away give finite losses and gradients."""
    loss = make_loss()
    batch = make_batch(loss, [1.0, 1.0], [0.5, -0.5])
    batch["action_log_prob"] += torch.tensor([400.0, -400.0])
    terms = loss(batch)
    (terms["loss_actor"] + terms["loss_critic"]).backward()
    assert all(p.grad.isfinite().all() for p in loss.parameters())


@pytest.mark.parametrize("baseline", ["stored", "target"])
def test_gradients_reach_only_the_network_of_each_term_and_never_the_targets(baseline):
    """The actor's loss trains the actor, the critic's the critic."""
    loss = make_loss(baseline=baseline)
    for term, trained in (("loss_actor", "actor"), ("loss_critic", "critic")):
        loss.zero_grad()
        loss(make_batch(loss, [1.4, 0.6], [0.3, -0.7]))[term].backward()
        for name, parameter in loss.named_parameters():
            moved = parameter.grad is not None and bool(parameter.grad.abs().sum() > 0)
            assert moved == name.startswith(trained), name
    assert not any(name.startswith("target") for name, _ in loss.named_parameters())


def test_the_threshold_survives_a_checkpoint():
    """Delta is in the state_dict."""
    loss, other = make_loss(), make_loss()
    loss(make_batch(loss, [3.0], [0.0]))
    other.load_state_dict(loss.state_dict())
    assert other.delta.item() == loss.delta.item() == pytest.approx(0.5)


def paper_loss_and_batch():
    """The paper's networks and tanh-squashed actions on a random batch."""
    torch.manual_seed(0)
    loss = PPORPELoss(make_actor(3, 2), make_critic(3))
    TSoftUpdate(loss)
    return loss, TensorDict(
        {
            "observation": torch.randn(8, 3),
            "action": torch.rand(8, 2) * 1.8 - 0.9,
            "action_log_prob": torch.randn(8) * 0.1 - 1.0,
            "priority_weight": torch.rand(8) + 0.1,
            "next": {
                "observation": torch.randn(8, 3),
                "reward": torch.randn(8, 1),
                "terminated": torch.rand(8, 1) > 0.7,
                "done": torch.rand(8, 1) > 0.7,
            },
        },
        [8],
    )


@pytest.mark.slow  # that there is no break, test_loss_contract finds out with L2C2 around it
def test_compiled_without_a_break_it_gives_the_same_losses():
    """One graph, the same numbers."""
    loss, batch = paper_loss_and_batch()
    delta = loss.delta.clone()
    eager = loss(batch.clone())
    loss.delta.copy_(delta)
    compiled = torch.compile(loss, fullgraph=True, backend="aot_eager")(batch.clone())
    for key in loss.out_keys:
        torch.testing.assert_close(compiled[key], eager[key])


def test_dispatch_takes_keyword_arguments():
    """The loss can be called without a TensorDict, as any TorchRL loss."""
    loss, batch = paper_loss_and_batch()
    del batch["priority_weight"]
    keywords = {
        "_".join(key) if isinstance(key, tuple) else key: batch[key] for key in loss.in_keys
    }
    outputs = loss(**keywords)
    torch.testing.assert_close(outputs[0], loss(batch)["loss_actor"])


@pytest.mark.parametrize(
    ("key", "told"),
    [("action_log_prob", "keep it, or take baseline='target'."), ("action", "keep it.")],
)
def test_a_batch_without_what_was_done_is_told(key, told):
    """Which entry it lacks."""
    loss = make_loss()
    batch = make_batch(loss, [1.2], [0.3]).exclude(key)
    with pytest.raises(KeyError, match=rf"no '{key}': {told}"):
        loss(batch)


@pytest.mark.parametrize("baseline", ["stored", "target"])
def test_a_rollout_that_keeps_gradients_is_learned_from_all_the_same(baseline):
    """As TorchRL's ``rollout`` does: those of the ratio's two sides would cancel."""
    torch.manual_seed(0)
    loss = PPORPELoss(make_actor(3, 2), make_critic(3), baseline=baseline)
    TSoftUpdate(loss)
    _, batch = paper_loss_and_batch()
    with set_exploration_type(ExplorationType.RANDOM):
        batch = loss.actor_network(batch.exclude("action", "action_log_prob"))
    assert batch["action"].requires_grad and batch["action_log_prob"].requires_grad
    loss.eval()  # The threshold stays.
    weights = list(loss.actor_network_params.values(True, True))
    found, expected = (
        torch.autograd.grad(loss(each)["loss_actor"], weights, retain_graph=True)
        for each in (batch, batch.detach())
    )
    assert all(gradient.abs().sum() > 0 for gradient in expected)
    torch.testing.assert_close(found, expected)


def test_weights_of_shape_b_1_are_those_of_shape_b():
    """They would be spread over every pair of transitions."""
    loss, batch = paper_loss_and_batch()
    expected = loss.eval()(batch.clone())
    batch["priority_weight"] = batch["priority_weight"].unsqueeze(-1)
    found = loss(batch)
    for key in ("loss_actor", "loss_critic"):
        torch.testing.assert_close(found[key], expected[key])


@pytest.mark.parametrize("reduction", ["mean", "sum", "none"])
def test_a_regularizers_weights_of_shape_b_1_are_those_of_shape_b(reduction):
    """Each transition's term times its own weight."""
    loss, batch = paper_loss_and_batch()
    loss.reduction = reduction
    loss = CATSLoss(loss)
    expected = loss(batch.clone())["loss_cats"]
    batch["priority_weight"] = batch["priority_weight"].unsqueeze(-1)
    assert torch.equal(loss(batch)["loss_cats"], expected)


def test_the_threshold_adapts_in_training_alone():
    """A validation loss leaves no trace."""
    loss, batch = paper_loss_and_batch()
    before = loss.delta.clone()
    terms = loss.eval()(batch.clone())
    assert torch.equal(loss.delta, before)
    assert terms["ratio_threshold"] == loss.kappa * before
    loss.train()(batch.clone())
    assert loss.delta > before


def test_renamed_keys_are_read():
    """set_keys moves every key, the value estimator's among them."""
    loss = make_loss()
    batch = make_batch(loss, [1.2], [0.3])
    expected = loss(batch.clone())["loss_critic"].item()
    loss.set_keys(reward="payoff", action="move", sample_log_prob="likelihood")
    renamed = batch.rename_key_("action", "move").rename_key_("action_log_prob", "likelihood")
    renamed["next"].rename_key_("reward", "payoff")
    assert loss(renamed)["loss_critic"].item() == pytest.approx(expected, rel=1e-5)
    assert "move" in loss.in_keys and ("next", "payoff") in loss.in_keys


@pytest.mark.parametrize(
    ("setting", "value"),
    [
        ("gamma", 1.0),
        ("gamma", math.nan),
        ("kappa", 0.0),
        ("kappa", 2.5),
        ("beta", 1.0),
        ("decay", 1.5),
        ("delta_min", 0.0),
        ("threshold", "median"),
        ("critic_weighting", "advantage"),
        ("baseline", "old"),
        ("importance", "sum"),
        ("reduction", "max"),
    ],
)
def test_wrong_settings_are_refused_with_what_is_allowed(setting, value):
    """The error names the setting, what was given and what is allowed."""
    with pytest.raises(ValueError, match=rf"{setting} must be .*, got"):
        make_loss(**{setting: value})
