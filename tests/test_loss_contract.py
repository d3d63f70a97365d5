"""What every regularized loss keeps of the loss it wraps, and what it adds: one battery for all."""

from __future__ import annotations

import copy
import pickle
import warnings

import pytest
import torch
from losses import CASES, Case
from tensordict import TensorDict, TensorDictBase, unravel_key
from torchrl.objectives import HardUpdate, LossModule, SoftUpdate

from torchrl_l2c2 import CAPSLoss, L2C2Loss, Neighborhood, NeighborTransform

SHARED = {"l2c2_distance", "l2c2_gain", "l2c2_counted"}
# A wide neighborhood, so that the terms are well above the rounding of the others.
NEAR = Neighborhood(sigma=1.0, lambda_min=0.2, lambda_max=2.0)

pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.fixture(params=CASES, ids=str)
def case(request: pytest.FixtureRequest) -> Case:
    return request.param


def plain(case: Case, seed: int = 0, **kwargs) -> LossModule:
    torch.manual_seed(seed)
    return case.make(**kwargs)


def regularized(case: Case, seed: int = 0, **kwargs) -> L2C2Loss:
    return L2C2Loss(plain(case, seed, **kwargs), NEAR)


def batch_of(
    case: Case, *shape: int, neighbors: int = 0, seed: int = 1, neighbor_seed: int = 1
) -> TensorDictBase:
    torch.manual_seed(seed)
    batch = case.batch(*(shape or (6,)))
    if neighbors:
        torch.manual_seed(neighbor_seed)
        NeighborTransform(NEAR, [case.observation], num_samples=neighbors)(batch)
    return batch


def run(loss: LossModule, batch: TensorDictBase, seed: int = 2) -> TensorDictBase:
    torch.manual_seed(seed)
    return loss(batch)


def total(terms: TensorDictBase) -> torch.Tensor:
    return sum(value.sum() for key, value in terms.items() if key.startswith("loss"))


def gradients(loss: LossModule, value: torch.Tensor) -> dict[str, torch.Tensor | None]:
    names, parameters = zip(*loss.named_parameters(), strict=True)
    return dict(zip(names, torch.autograd.grad(value, parameters, allow_unused=True), strict=True))


def equal(a: torch.Tensor | TensorDictBase, b: torch.Tensor | TensorDictBase) -> bool:
    return bool((a == b).all())


def expected_keys(case: Case) -> set[str]:
    policy = set() if case.policy is None else {case.policy}
    values = {"l2c2_value_distance"} if case.values else set()
    return {*case.terms, *SHARED, *policy, *values}


class TestWhatIsAdded:
    def test_it_is_an_instance_of_both_classes(self, case):
        """Code that asks for the loss's own class, and code that asks for L2C2Loss, both go on."""
        loss = regularized(case)
        base = type(plain(case))
        assert isinstance(loss, L2C2Loss) and isinstance(loss, base)
        assert type(loss) is L2C2Loss[base]
        assert type(loss).__name__ == f"L2C2Loss[{base.__name__}]"

    def test_exactly_the_promised_entries_are_added(self, case):
        """The output is the plain loss's plus its terms and diagnostics, in out_keys as well."""
        added = set(run(regularized(case), batch_of(case)).keys())
        added -= set(run(plain(case), batch_of(case)).keys())
        assert added == expected_keys(case)
        assert expected_keys(case) <= set(regularized(case).out_keys)

    def test_terms_train_and_diagnostics_do_not(self, case):
        """Terms are positive scalars with a gradient; diagnostics are finite without one."""
        terms = run(regularized(case), batch_of(case))
        for key in expected_keys(case):
            assert terms[key].shape == () and terms[key].isfinite()
            assert terms[key] > 0
            assert terms[key].requires_grad == key.startswith("loss_")

    def test_next_observations_are_in_in_keys(self, case):
        """A batch reduced to in_keys is enough, neighbors being drawn from s and s'."""
        loss = regularized(case)
        if case.declares_keys:
            run(loss, batch_of(case).select(*loss.in_keys, strict=False))
            assert {unravel_key(key) for key in plain(case).in_keys} <= set(loss.in_keys)

    def test_each_term_reaches_the_parameters_of_its_own_network_alone(self, case):
        """The policy term trains the policy, a value term its value function, nothing else."""
        loss = regularized(case)
        terms = run(loss, batch_of(case))
        for term in case.terms:
            network = term.removeprefix("loss_l2c2_")
            touched = {
                name.split("_network_params")[0]
                for name, gradient in gradients(loss, terms[term]).items()
                if gradient is not None and gradient.abs().sum() > 0
            }
            assert touched == {network}

    def test_both_regularizers_give_what_forward_gives(self, case):
        """Loops that call actor_loss and value_loss get the same terms from the two methods."""
        loss, batch = regularized(case), batch_of(case, neighbors=1)
        terms = run(loss, batch.copy())
        parts = loss.policy_regularizer(batch).update(loss.value_regularizer(batch))
        assert set(parts.keys()) == expected_keys(case)
        for key, value in parts.items():
            torch.testing.assert_close(value, terms[key])

    def test_neighbors_are_read_from_the_batch_where_it_has_them(self, case):
        """With the transform's entry nothing is drawn: the seed does not matter."""
        loss, batch = regularized(case), batch_of(case, neighbors=2)
        for term in case.terms:
            assert equal(run(loss, batch.copy(), 3)[term], run(loss, batch.copy(), 4)[term])
        batch["neighbor", "distance"] = 2 * batch["neighbor", "distance"]
        halved = run(loss, batch, 3)
        batch["neighbor", "distance"] = 0.5 * batch["neighbor", "distance"]
        for term in case.terms:
            torch.testing.assert_close(2 * halved[term], run(loss, batch, 3)[term])

    def test_neighbors_drawn_by_the_loss_are_those_of_the_transform(self, case):
        """Without the entry the loss draws what NeighborTransform draws with the same seed."""
        loss, batch = regularized(case), batch_of(case)
        torch.manual_seed(5)
        drawn = loss.value_regularizer(batch)
        written = loss.value_regularizer(batch_of(case, neighbors=1, neighbor_seed=5))
        for key, value in drawn.items():
            assert equal(value, written[key])

    def test_a_missing_next_observation_is_named(self, case):
        """The error of a batch without successors says which entry is missing."""
        batch = batch_of(case)
        del batch[unravel_key(("next", case.observation))]
        with pytest.raises(KeyError, match=r"next observation.*'next', .*'observation'"):
            loss = regularized(case)
            (loss.value_regularizer if case.values else loss.policy_regularizer)(batch)

    def test_next_observations_that_are_not_finite_do_no_harm(self, case):
        """Rows with NaN at an episode's end do not count: values and gradients of the others."""
        batch = batch_of(case)
        successor = batch[unravel_key(("next", case.observation))]
        successor[0], successor[1] = torch.nan, torch.inf
        loss = regularized(case)
        with pytest.warns(UserWarning, match=r"33\.33% of the transitions in the batch"):
            terms = loss.value_regularizer(batch).update(loss.policy_regularizer(batch))
        assert terms["l2c2_counted"].item() == pytest.approx(4 / 6)
        assert all(value.isfinite().all() for value in terms.values())
        found = gradients(loss, total(terms)).values()
        assert all(gradient is None or gradient.isfinite().all() for gradient in found)


class TestWhatIsKept:
    def test_the_losss_own_values_are_unchanged_bit_for_bit(self, case):
        """The plain loss draws first, so one seed gives its own numbers."""
        before, after = run(plain(case), batch_of(case)), run(regularized(case), batch_of(case))
        for key, value in before.items():
            assert equal(value, after[key])

    def test_a_gain_of_zero_is_the_plain_loss_bit_for_bit(self, case):
        """Values, gradients and buffers are those of the plain loss where coeff is 0."""
        base, loss = plain(case), L2C2Loss(plain(case), NEAR, coeff=0.0)
        expected, found = total(run(base, batch_of(case))), total(run(loss, batch_of(case)))
        assert torch.equal(expected, found)
        ours = gradients(loss, found)
        for name, gradient in gradients(base, expected).items():
            assert torch.equal(gradient, ours[name])
        for name, value in base.state_dict().items():
            assert torch.equal(value, loss.state_dict()[name])

    def test_the_wrapped_loss_stays_plain(self, case):
        """The object that was wrapped neither becomes regularized nor follows its keys."""
        base = plain(case)
        before = run(base, batch_of(case))  # the value estimator is made here
        keys = copy.copy(base.tensor_keys)
        loss = L2C2Loss(base, NEAR)
        loss.set_keys(**{"reward" if case.values else "action": "other"})
        after = run(base, batch_of(case))
        assert type(base) is type(plain(case))
        assert set(after.keys()) == set(before.keys())
        assert base.tensor_keys == keys

    def test_networks_parameters_and_targets_are_the_same_objects(self, case):
        """An optimizer made before wrapping trains the regularized loss."""
        base = plain(case)
        loss = L2C2Loss(base, NEAR)
        theirs, ours = dict(base.named_parameters()), dict(loss.named_parameters())
        assert theirs.keys() == ours.keys() and theirs
        assert all(theirs[name] is ours[name] for name in theirs)
        buffers = dict(loss.named_buffers())
        assert all(value is buffers[name] for name, value in base.named_buffers())

    def test_checkpoints_are_interchangeable_with_the_plain_loss(self, case):
        """state_dict has the plain loss's keys, and either loads the other's."""
        base, loss = plain(case, seed=3), regularized(case)
        assert list(loss.state_dict()) == list(base.state_dict())
        loss.load_state_dict(base.state_dict())
        other = plain(case)
        other.load_state_dict(loss.state_dict())
        expected = run(base, batch_of(case))
        for each in (loss, other):
            found = run(each, batch_of(case))
            assert all(equal(value, found[key]) for key, value in expected.items())

    def test_copies_are_independent_and_equal(self, case):
        """deepcopy gives a regularized loss of its own."""
        loss = L2C2Loss(plain(case), NEAR, coeff=0.5)
        twin = copy.deepcopy(loss)
        assert type(twin) is type(loss)
        for key in case.terms:
            assert equal(run(loss, batch_of(case))[key], run(twin, batch_of(case))[key])
        with torch.no_grad():
            for parameter in twin.parameters():
                parameter.zero_()
        assert any(parameter.abs().sum() > 0 for parameter in loss.parameters())

    def test_it_pickles_where_the_plain_loss_does(self, case):
        """The class made at run time is found again from the two it is made of."""
        try:
            pickle.dumps(plain(case))
        except (AttributeError, pickle.PicklingError):
            pytest.skip("the plain loss does not pickle")
        loss = regularized(case)
        twin = pickle.loads(pickle.dumps(loss))
        assert type(twin) is type(loss)
        for key in case.terms:
            assert equal(run(loss, batch_of(case))[key], run(twin, batch_of(case))[key])

    def test_target_updaters_find_the_targets(self, case):
        """SoftUpdate and HardUpdate move the targets, as for the plain loss."""
        loss = regularized(case)
        if not case.has_targets:
            with pytest.raises(RuntimeError, match="Did not find any target"):
                SoftUpdate(loss, tau=0.5)
            return
        updaters = (
            SoftUpdate(loss, tau=0.5),
            HardUpdate(loss, value_network_update_interval=0),
        )
        for updater in updaters:
            with torch.no_grad():
                for parameter in loss.parameters():
                    parameter.add_(1.0)
            before = {n: b.clone() for n, b in loss.named_buffers() if n.startswith("target_")}
            updater.step()
            moved = [n for n, b in loss.named_buffers() if n in before and not equal(b, before[n])]
            assert moved

    def test_value_estimators_can_be_chosen(self, case):
        """make_value_estimator acts as on the plain loss."""
        base, loss = plain(case), regularized(case)
        if not (case.declares_keys and case.values):
            pytest.skip("the plain loss has no value estimator")
        for each in (base, loss):
            each.make_value_estimator(gamma=0.5)
        expected, found = run(base, batch_of(case)), run(loss, batch_of(case))
        assert all(equal(value, found[key]) for key, value in expected.items())

    def test_keys_can_be_renamed(self, case):
        """set_keys acts as on the plain loss, and in_keys follow."""
        if not case.values:
            pytest.skip("behavior cloning reads no rewards")
        batch = batch_of(case, neighbors=1)
        batch["next"].rename_key_("reward", "other_reward")
        expected = run(regularized(case), batch_of(case, neighbors=1))
        loss = regularized(case)
        loss.set_keys(reward="other_reward")
        found = run(loss, batch)
        assert all(equal(value, found[key]) for key, value in expected.items())
        if case.declares_keys:
            assert ("next", "other_reward") in loss.in_keys
            assert ("next", "reward") not in loss.in_keys
            batch = batch.exclude("neighbor").select(*loss.in_keys, strict=False)
            assert case.terms[0] in set(run(loss, batch).keys())

    def test_out_keys_can_be_selected(self, case):
        """select_out_keys leaves the entries that were asked for, and can be undone."""
        if not (case.declares_keys and case.selects):
            pytest.skip("the plain loss does not do so either")
        loss, batch = regularized(case), batch_of(case)
        keys, wanted = list(loss.out_keys), [case.terms[0], "l2c2_gain"]
        loss.select_out_keys(*wanted)
        assert loss.out_keys == wanted
        # Some versions of torchrl leave entries that a loss writes without declaring them.
        assert set(run(loss, batch).keys()) & set(keys) == set(wanted)
        loss.reset_out_keys()
        assert loss.out_keys == keys

    def test_it_can_be_called_with_keyword_arguments(self, case):
        """Without a tensordict the outputs come in the order of out_keys."""
        if not case.keywords:
            pytest.skip("the plain loss takes a tensordict alone")
        loss, batch = regularized(case), batch_of(case)
        loss.select_out_keys(*case.terms)
        arguments = {
            "_".join(key) if isinstance(key, tuple) else key: batch[key]
            for key in loss.in_keys
            if key in batch.keys(True)
        }
        torch.manual_seed(2)
        found = loss(**arguments)
        found = found if isinstance(found, tuple) else (found,)
        expected = run(regularized(case), batch)
        for value, key in zip(found, case.terms, strict=True):
            torch.testing.assert_close(value, expected[key])


class TestHowTermsAreReduced:
    def test_reductions_agree(self, case):
        """The sum and the mean are those of the unreduced values, whose shape is the batch's."""
        if "none" not in case.reductions:
            pytest.skip("the plain loss has no choice of reductions")
        batch = batch_of(case, neighbors=1)
        found = {r: run(regularized(case, reduction=r), batch.copy()) for r in case.reductions}
        for key in case.terms:
            values = found["none"][key]
            assert values.shape[:1] == batch.shape
            torch.testing.assert_close(found["mean"][key], values.mean())
            torch.testing.assert_close(found["sum"][key], values.sum())

    def test_priority_weights_are_used_where_the_loss_uses_them(self, case):
        """The weighted mean for losses that weight their own terms, the plain one for others."""
        if "none" not in case.reductions:
            pytest.skip("the plain loss has no choice of reductions")
        batch = batch_of(case, neighbors=1)
        values = run(regularized(case, reduction="none"), batch.copy())
        batch["priority_weight"] = weights = torch.linspace(0.1, 1.0, 6)
        found = run(regularized(case), batch)
        for key in case.terms:
            value = values[key]
            if case.weighted:
                value = (weights * value).sum() / weights.sum()
            torch.testing.assert_close(found[key], value.mean())

    def test_masked_positions_do_not_count(self, case):
        """The validity masks that TorchRL writes leave positions out, as for the loss's terms."""
        if "none" not in case.reductions:
            pytest.skip("the plain loss has no choice of reductions")
        batch = batch_of(case, neighbors=1)
        values = run(regularized(case, reduction="none"), batch.copy())
        mask = torch.tensor([True, False, True, True, False, False])
        batch["collector"] = TensorDict({"mask": mask.unsqueeze(-1)}, batch_size=[6])
        loss = regularized(case)
        found = loss.policy_regularizer(batch).update(loss.value_regularizer(batch))
        for key in case.terms:
            torch.testing.assert_close(found[key], values[key][mask].mean())

    def test_a_gain_may_be_set_before_the_backward_pass(self, case):
        """The gradient is that of the gain that the terms were made with."""
        loss, batch = regularized(case), batch_of(case, neighbors=1)
        parameters = [p for p in loss.parameters() if p.requires_grad]
        gradients = []
        for later in (loss.l2c2_coeff.item(), 0.0):
            terms = loss.policy_regularizer(batch.copy())
            terms.update(loss.value_regularizer(batch.copy()))
            total = sum(terms[key].sum() for key in case.terms)
            coeff, loss.l2c2_coeff = loss.l2c2_coeff.item(), later
            gradients.append(torch.autograd.grad(total, parameters, allow_unused=True))
            loss.l2c2_coeff = coeff
        for expected, found in zip(*gradients, strict=True):
            assert (found is None and expected is None) or torch.equal(found, expected)

    def test_batches_of_trajectories_are_taken(self, case):
        """A batch [B, T] gives the same terms as its transitions in one row."""
        if not case.trajectories:
            pytest.skip("the plain loss takes batches of one dimension alone")
        loss, batch = regularized(case), batch_of(case, 2, 3, neighbors=2)
        rows = batch.reshape(-1)
        for method in (loss.policy_regularizer, loss.value_regularizer):
            flat = method(rows)
            for key, value in method(batch).items():
                torch.testing.assert_close(value, flat[key])

    def test_precision_follows_the_networks(self, case):
        """Cast to float64, networks and batch give float64 terms."""
        loss = regularized(case).double()
        batch = batch_of(case, neighbors=1)
        batch = batch.apply(lambda x: x.double() if x.is_floating_point() else x)
        terms = loss.policy_regularizer(batch).update(loss.value_regularizer(batch))
        single = batch_of(case, neighbors=1)
        expected = regularized(case)
        expected = expected.policy_regularizer(single).update(expected.value_regularizer(single))
        for key in case.terms:
            assert terms[key].dtype == torch.float64
            torch.testing.assert_close(terms[key].float(), expected[key], rtol=1e-3, atol=1e-8)


class TestSchedules:
    def test_gains_can_be_scheduled(self, case):
        """Assigned gains scale the terms; l2c2_gain shows what is applied."""
        loss, batch = regularized(case), batch_of(case, neighbors=1)
        before = run(loss, batch.copy())
        buffer = loss.l2c2_coeff
        loss.l2c2_coeff = 0.5
        if case.values:
            loss.l2c2_beta = 0.3
        assert loss.l2c2_coeff is buffer
        after = run(loss, batch)
        for key in case.terms:
            factor = 0.5 if key == "loss_l2c2_actor" else 0.5 * 3
            torch.testing.assert_close(after[key], factor * before[key])
        torch.testing.assert_close(after["l2c2_gain"], 0.5 * before["l2c2_gain"])

    def test_beta_zero_leaves_out_the_value_terms(self, case):
        """The paper's ablation: no value term, no evaluation, and no way to switch it on later."""
        if case.policy is None:
            with pytest.raises(TypeError, match="nothing to regularize"):
                L2C2Loss(plain(case), beta=0)
            return
        base = plain(case)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            loss = L2C2Loss(base, NEAR, beta=0)
        terms = run(loss, batch_of(case))
        found = {key for key in set(terms.keys()) if "l2c2" in key}
        assert found == {"loss_l2c2_actor", case.policy, *SHARED}
        assert found <= set(loss.out_keys)
        with pytest.raises(ValueError, match="l2c2_beta has nothing to scale"):
            loss.l2c2_beta = 0.1

    def test_a_missing_term_is_pointed_out(self, case):
        """Losses without a policy, or without values, say what is left out; others say nothing."""
        base = plain(case)
        if case.policy is None or not case.values:
            term = "value" if case.policy else "policy"
            with pytest.warns(UserWarning, match=f"leaves out the {term} term"):
                L2C2Loss(base)
        else:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                L2C2Loss(base, NEAR)


def test_regularizers_can_be_combined(case):
    """CAPS over L2C2 returns the terms of both, or refuses where there is no policy."""
    loss = regularized(case)
    if case.policy is None:
        with pytest.raises(TypeError, match="CAPSLoss needs a policy"):
            CAPSLoss(loss)
        return
    both = CAPSLoss(regularized(case))
    expected, found = run(loss, batch_of(case)), run(both, batch_of(case))
    assert isinstance(both, L2C2Loss) and isinstance(both, CAPSLoss)
    assert all(equal(value, found[key]) for key, value in expected.items())
    added = {"loss_caps_temporal", "loss_caps_spatial", "caps_counted"}
    assert added == set(found.keys()) - set(expected.keys())
    assert set(found.keys()) - set(run(plain(case), batch_of(case)).keys()) <= set(both.out_keys)
    both.l2c2_coeff = 0.0
    both.caps_lambda_spatial = 0.0
    assert copy.deepcopy(both).l2c2_coeff == 0
    assert list(both.state_dict()) == list(loss.state_dict())


# Compiling all of them takes over a minute.
COMPILED = [
    pytest.param(case, marks=() if case.name in ("PPORPE", "ClipPPO") else pytest.mark.slow)
    for case in CASES
    if case.fullgraph
]


@pytest.mark.parametrize("case", COMPILED, ids=str)
def test_it_compiles_into_one_graph_where_the_plain_loss_does(case):
    """Compiled, it gives the eager numbers; a new gain does not compile it again."""
    torch._dynamo.reset()
    loss, batch = regularized(case), batch_of(case)
    run(loss, batch.copy())  # some losses make attributes in their first call
    if hasattr(loss, "target_critic_network_params") and case.name != "PPORPE":
        targets = loss.target_critic_network_params
        loss.value_estimator(batch, params=loss.critic_network_params, target_params=targets)
    graphs = []

    def backend(graph: torch.fx.GraphModule, inputs: list[torch.Tensor]) -> torch.fx.GraphModule:
        graphs.append(graph)
        return graph

    compiled = torch.compile(loss, fullgraph=True, backend=backend)
    for coeff in (1.0, 0.5):
        loss.l2c2_coeff = coeff
        found, expected = run(compiled, batch.copy()), run(loss, batch.copy())
        for key in case.terms:
            torch.testing.assert_close(found[key], expected[key])
    assert len(graphs) == 1
