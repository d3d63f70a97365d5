"""The t-soft update against its recursion, and as a TorchRL updater."""

import copy
import io
import math

import pytest
import torch
from tensordict.nn import TensorDictModule, TensorDictParams
from torch import nn
from torch._dynamo.testing import CompileCounterWithBackend
from torchrl.modules import Actor, ValueOperator
from torchrl.objectives import DDPGLoss, LossModule, TD3Loss
from torchrl.objectives.utils import SoftUpdate

from torchrl_l2c2 import TSoftUpdate
from torchrl_l2c2.updaters import t_soft_update


class TwoNetworks(LossModule):
    """Only what an updater sees of a loss: two networks and their targets."""

    actor: TensorDictModule
    actor_params: TensorDictParams
    target_actor_params: TensorDictParams
    critic: TensorDictModule
    critic_params: TensorDictParams
    target_critic_params: TensorDictParams

    def __init__(self, expand_dim=None):
        super().__init__()
        torch.manual_seed(0)
        for name, sizes, expand in (("actor", (3, 2), None), ("critic", (3, 1), expand_dim)):
            network = nn.Sequential(nn.Linear(sizes[0], 4), nn.Linear(4, sizes[1]))
            self.convert_to_functional(
                TensorDictModule(network, ["x"], [name]),
                name,
                expand_dim=expand,
                create_target_params=True,
            )

    def pairs(self):
        """Names, parameters and targets, in one order."""
        for network in ("actor", "critic"):
            sources = getattr(self, f"{network}_params").flatten_keys(".")
            targets = getattr(self, f"target_{network}_params").flatten_keys(".")
            for name, source in sources.items():
                yield f"{network}_params.{name}", source, targets[name]

    def targets(self):
        return [target.clone() for _, _, target in self.pairs()]

    def walk(self, seed, scale=1e-3, jump=0.0):
        """Moves every parameter at random, and the first one by a jump."""
        torch.manual_seed(seed)
        for i, (_, source, _) in enumerate(self.pairs()):
            source.data += scale * torch.randn(source.shape).to(source.dtype)
            source.data += jump * (i == 0)


def reference_step(target, source, weight, scale, tau, nu):
    """One tensor, one step, the equations one by one."""
    distance = ((target - source) ** 2).mean()
    w = (nu + 1) / (nu + distance / scale)
    target = target + w / (weight + w) * (source - target)
    scale = scale + tau * w * nu / (nu + 1) * (distance - scale)
    return target, (1 - tau) * (weight + w), scale


def close(a, b, rtol=1e-9):
    for x, y in zip(a, b, strict=True):
        torch.testing.assert_close(x, y, rtol=rtol, atol=1e-12)


def test_three_steps_by_hand():
    """A usual distance, a jump, and a source that stands where its target is.

    With W = s2 = 1 and tau = 1/2: D2 = 1 gives w = 1 and half the way; D2 = 9 gives w = 1/5 and a
    sixth of the way; D2 = 0 gives w = 2 and no move.
    """
    target, weight, scale = torch.tensor([0.0]), torch.tensor([1.0]), torch.tensor([1.0])
    for source, expected in (
        (1.0, (0.5, 1.0, 1.0)),
        (3.5, (1.0, 0.6, 1.4)),
        (1.0, (1.0, 1.3, 0.7)),
    ):
        t_soft_update([target], [torch.tensor([source])], weight, scale, tau=0.5, nu=1.0)
        result = (target.item(), weight.item(), scale.item())
        assert result == pytest.approx(expected, rel=1e-6)


def test_it_starts_as_the_paper_says():
    """Targets equal their sources, and a source at distance 1e-4 is followed with tau exactly."""
    loss = TwoNetworks().double()
    updater = TSoftUpdate(loss, tau=0.2)
    for _, source, target in loss.pairs():
        assert torch.equal(source, target)
        source.data += 1e-4
    before = loss.targets()
    updater.step()
    for old, new in zip(before, loss.targets(), strict=True):
        torch.testing.assert_close(new - old, torch.full_like(old, 2e-5), rtol=1e-6, atol=0.0)


@pytest.mark.parametrize(("tau", "nu"), [(0.1, 1.0), (0.5, 3.0)])
@pytest.mark.parametrize("expand_dim", [None, 3], ids=["single", "ensemble"])
def test_every_tensor_follows_the_recursion(tau, nu, expand_dim):
    """Thirty steps of random walks with jumps; an ensemble's copies count as one tensor."""
    loss = TwoNetworks(expand_dim).double()
    updater = TSoftUpdate(loss, tau=tau, nu=nu)
    names = [name for name, _, _ in loss.pairs()]
    expected = loss.targets()
    weights, scales = [(1 - tau) / tau] * len(names), [1e-8] * len(names)
    for seed in range(30):
        loss.walk(seed, jump=float(seed % 7 == 3))
        updater.step()
        for i, (_, source, _) in enumerate(loss.pairs()):
            step = expected[i], source.detach(), weights[i], scales[i]
            expected[i], weights[i], scales[i] = reference_step(*step, tau, nu)
    close(loss.targets(), expected)
    state = updater.state_dict()
    close([state["weight"][name] for name in names], weights)
    close([state["scale"][name] for name in names], scales)


def test_with_infinite_nu_it_is_torchrls_soft_update():
    """Twenty steps give the same targets, jumps included."""
    loss, plain = TwoNetworks().double(), TwoNetworks().double()
    updater, soft = TSoftUpdate(loss, tau=0.3, nu=math.inf), SoftUpdate(plain, tau=0.3)
    for seed in range(20):
        for module in (loss, plain):
            module.walk(seed, jump=float(seed == 5))
        updater.step()
        soft.step()
    close(loss.targets(), plain.targets())


def test_with_tau_one_targets_become_their_sources():
    """As with the ordinary soft update."""
    loss = TwoNetworks()
    updater = TSoftUpdate(loss, tau=1.0)
    loss.walk(0, scale=1.0)
    updater.step()
    for _, source, target in loss.pairs():
        torch.testing.assert_close(source.detach(), target)


def test_a_jump_is_held_back_and_what_stays_is_followed():
    """One far step moves the target far less than tau; it arrives if the source stays there."""
    loss = TwoNetworks()
    updater = TSoftUpdate(loss)
    for seed in range(50):
        loss.walk(seed)
        updater.step()
    _, source, target = next(loss.pairs())
    before = target.clone()
    source.data += 1.0
    updater.step()
    assert ((target - before) / (source - before)).abs().max() < 0.001
    for _ in range(300):
        updater.step()
    torch.testing.assert_close(target, source.detach(), rtol=1e-3, atol=1e-3)


def test_targets_stay_between_where_they_were_and_their_sources():
    """Whatever the statistics, a step is a convex combination."""
    torch.manual_seed(0)
    for _ in range(100):
        n = 4
        targets = [torch.randn(3) for _ in range(n)]
        sources = [t + torch.randn(3) * 10.0 ** torch.randint(-6, 3, ()) for t in targets]
        weight, scale = 10.0 ** torch.empty(2, n).uniform_(-8, 2)
        old = [t.clone() for t in targets]
        t_soft_update(targets, sources, weight, scale, tau=0.1, nu=1.0)
        for before, now, source in zip(old, targets, sources, strict=True):
            assert (now >= torch.minimum(before, source) - 1e-6).all()
            assert (now <= torch.maximum(before, source) + 1e-6).all()
        assert (scale > 0.0).all()
        assert (weight > 0.0).all()


def test_a_source_that_stood_still_for_long_is_followed_again():
    """A frozen layer must not end in 0 / 0; its target needs some hundred steps to wake up."""
    loss = TwoNetworks()
    updater = TSoftUpdate(loss)
    for _ in range(2000):
        updater.step()
    assert all(target.isfinite().all() for target in loss.targets())
    for _, source, _ in loss.pairs():
        source.data += 1e-2
    for _ in range(200):
        updater.step()
    for _, source, target in loss.pairs():
        torch.testing.assert_close(target, source.detach(), rtol=0.0, atol=1e-4)


def test_an_ensemble_shares_one_statistic():
    """A jump of one copy holds back the others, too, as the mean is over the stored tensor."""
    qvalue = ValueOperator(nn.Bilinear(3, 1, 1), in_keys=["observation", "action"])
    loss = TD3Loss(Actor(nn.Linear(3, 1)), qvalue, bounds=(-1.0, 1.0), num_qvalue_nets=2)
    updater = TSoftUpdate(loss)
    source = loss.qvalue_network_params["module", "bias"]
    target = loss.target_qvalue_network_params["module", "bias"]
    assert source.shape == (2, 1)
    source.data[0] += 1.0
    source.data[1] += 1e-4
    before = target.clone()
    updater.step()
    # D2 = 1/2, so w = 2 / (1 + 5e7) and the pace is w / (9 + w).
    pace = (target - before)[1] / 1e-4
    assert pace.item() < 1e-3
    assert updater.state_dict()["weight"]["qvalue_network_params.module.bias"].shape == ()


def test_only_networks_with_targets_are_followed():
    """DDPG with a delayed value alone: there are no statistics of the actor."""
    qvalue = ValueOperator(nn.Bilinear(3, 1, 1), in_keys=["observation", "action"])
    loss = DDPGLoss(Actor(nn.Linear(3, 1)), qvalue, delay_value=True)
    names = TSoftUpdate(loss).state_dict()["weight"]
    assert set(names) == {f"value_network_params.module.{n}" for n in ("weight", "bias")}


def test_frozen_parameters_are_left_alone():
    """A source that needs no gradient has no distinct target, as with every TorchRL updater."""
    loss = TwoNetworks()
    frozen = loss.actor_params["module", "0", "bias"].requires_grad_(False)
    updater, plain = TSoftUpdate(loss), SoftUpdate(loss, tau=0.1)
    start = loss.target_actor_params["module", "0", "bias"].clone()
    frozen.data += 1e-4
    for one in (updater, plain):
        one.step()
        assert torch.equal(loss.target_actor_params["module", "0", "bias"], start)
    assert "actor_params.module.0.bias" not in updater.state_dict()["weight"]


def test_what_it_cannot_update_is_refused():
    """A loss without targets, and something that is not a loss."""
    qvalue = ValueOperator(nn.Bilinear(3, 1, 1), in_keys=["observation", "action"])
    with pytest.raises(RuntimeError, match="Did not find any target parameters"):
        TSoftUpdate(DDPGLoss(Actor(nn.Linear(3, 1)), qvalue, delay_value=False))
    with pytest.raises(ValueError, match="must be a LossModule"):
        TSoftUpdate(nn.Linear(1, 1))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"tau": 0.0}, r"tau must be in \(0, 1\], got 0.0"),
        ({"tau": 1.5}, r"tau must be in \(0, 1\], got 1.5"),
        ({"tau": math.nan}, r"tau must be in \(0, 1\]"),
        ({"nu": 0.0}, "nu must be at least 1e-30, got 0.0. math.inf gives"),
        ({"nu": 1e-40}, "nu must be at least 1e-30, got 1e-40"),
        ({"nu": math.nan}, "nu must be at least 1e-30"),
    ],
)
def test_wrong_settings_are_refused(settings, message):
    """At construction, naming the setting and what is allowed."""
    with pytest.raises(ValueError, match=message):
        TSoftUpdate(TwoNetworks(), **settings)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_targets_in_half_precision_follow_as_in_single(dtype):
    """But for their rounding; 1e-8 is 0 in float16, and its squared distances are."""
    loss, single = TwoNetworks().to(dtype), TwoNetworks().to(dtype).float()
    updater, expected = TSoftUpdate(loss), TSoftUpdate(single)
    start = single.targets()
    for seed in range(5):
        for module, one in ((loss, updater), (single, expected)):
            module.walk(seed, scale=0.05)
            one.step()
    resolution = torch.finfo(dtype).eps
    for half, whole, first in zip(loss.targets(), single.targets(), start, strict=True):
        torch.testing.assert_close(half.float(), whole, rtol=0.0, atol=10 * resolution)
        assert not whole.equal(first)
    # Which move too little here to be told by: in half precision the scales would be 0.
    torch.testing.assert_close(updater._scale, expected._scale, rtol=0.1, atol=0.0)


def test_the_smallest_nu_leaves_numbers():
    """Of sources that stand where their targets are, which weigh most, and of a jump."""
    loss = TwoNetworks()
    updater = TSoftUpdate(loss, tau=1e-3, nu=1e-30)
    for jump in (0.0, 1.0, 0.0):
        loss.walk(0, scale=0.0, jump=jump)
        updater.step()
    numbers = [*loss.targets(), updater._weight, updater._scale]
    assert all(each.isfinite().all() for each in numbers)


def test_its_state_resumes_bit_for_bit():
    """Loss and updater saved to disk in the safe format and loaded into fresh ones."""
    loss = TwoNetworks()
    updater = TSoftUpdate(loss)
    for seed in range(5):
        loss.walk(seed)
        updater.step()
    file = io.BytesIO()
    torch.save((loss.state_dict(), updater.state_dict()), file)
    file.seek(0)
    other = TwoNetworks()
    resumed = TSoftUpdate(other)
    loss_state, updater_state = torch.load(file, weights_only=True)
    other.load_state_dict(loss_state)
    resumed.load_state_dict(updater_state)
    for seed in range(5, 10):
        for module in (loss, other):
            module.walk(seed, jump=float(seed == 7))
        updater.step()
        resumed.step()
    for mine, theirs in zip(loss.targets(), other.targets(), strict=True):
        assert torch.equal(mine, theirs)
    assert updater.state_dict() == resumed.state_dict()


def test_a_state_is_a_snapshot():
    """Steps after it do not change it."""
    loss = TwoNetworks()
    updater = TSoftUpdate(loss)
    state = updater.state_dict()
    expected = copy.deepcopy(state)
    loss.walk(0)
    updater.step()
    assert state == expected
    assert updater.state_dict() != expected


def test_a_state_of_other_networks_is_refused():
    """Naming what is missing and what is too much, and without changing anything."""
    updater = TSoftUpdate(TwoNetworks())
    before = updater.state_dict()
    state = copy.deepcopy(before)
    state["scale"]["other_params.weight"] = state["scale"].pop("actor_params.module.0.bias")
    state["weight"] = {name: torch.tensor(5.0) for name in state["weight"]}
    with pytest.raises(
        KeyError, match=r"missing \['actor_params.module.0.bias'\], unexpected \['other_params"
    ):
        updater.load_state_dict(state)
    with pytest.raises(KeyError, match="'weight' does not fit"):
        updater.load_state_dict({"initialized": True})
    assert updater.state_dict() == before


def test_it_follows_a_loss_that_is_moved():
    """A loss cast to float64 after construction is updated as one that always was."""
    loss, always = TwoNetworks(), TwoNetworks().double()
    updater, expected = TSoftUpdate(loss), TSoftUpdate(always)
    loss.double()
    for seed in range(3):
        for module, one in ((loss, updater), (always, expected)):
            module.walk(seed)
            one.step()
    assert updater.state_dict()["scale"]["actor_params.module.0.bias"].dtype == torch.float64
    close(loss.targets(), always.targets(), rtol=1e-6)


def test_compiled_it_gives_the_same_numbers_from_one_graph():
    """One graph for all steps, also after a state was loaded."""
    torch._dynamo.reset()
    loss, plain = TwoNetworks(), TwoNetworks()
    updater, expected = TSoftUpdate(loss), TSoftUpdate(plain)
    counter = CompileCounterWithBackend("aot_eager")

    @torch.compile(backend=counter, fullgraph=True)
    def update():
        updater.step()

    for seed in range(4):
        for module in (loss, plain):
            module.walk(seed)
        update()
        expected.step()
        state = updater.state_dict()
        updater.load_state_dict(state)
    for mine, theirs in zip(loss.targets(), plain.targets(), strict=True):
        assert torch.equal(mine, theirs)
    assert updater.state_dict() == expected.state_dict()
    assert counter.frame_count == 1
