"""Gains that set themselves: by hand, in closed loops, and in a run that is continued."""

from __future__ import annotations

import dataclasses
import math
import statistics
import warnings
from copy import deepcopy

import pytest
import torch
from losses import CASES
from small import ALGORITHMS

from torchrl_l2c2 import (
    CAPSLoss,
    L2C2Loss,
    Neighborhood,
    NeighborTransform,
    PPORPELoss,
    make_actor,
    make_critic,
)
from torchrl_l2c2.experiment import (
    AdamConfig,
    Experiment,
    ExperimentConfig,
    L2C2Config,
    PPOConfig,
    PPORPEConfig,
    RolloutReplayConfig,
    TaskConfig,
    UniformReplayConfig,
)
from torchrl_l2c2.experiment.settings.fields import SettingError
from torchrl_l2c2.gains import TargetGain, gradient_shares


class TestByHand:
    def test_what_was_measured_may_be_a_tensor(self):
        """Of one number; gain and state are plain numbers, as a file has them."""
        gain, like = (TargetGain(2.0) for _ in range(2))
        assert gain.step(torch.tensor([0.5])) == like.step(0.5)
        assert all(type(value) in (int, float) for value in gain.state_dict().values())
        with pytest.raises(TypeError, match=r"measured must be a single number, .*\(2,\)"):
            gain.step(torch.ones(2))
        assert gain.state_dict() == like.state_dict()

    def test_cloning_that_takes_the_actors_place_is_none_of_its_gradient(self):
        """CQL's two terms of the policy are descended one after the other, and never summed."""
        torch.manual_seed(0)
        case = next(case for case in CASES if case.name == "CQL")
        loss, batch = L2C2Loss(case.make(), Neighborhood()), case.batch(8)
        batch = NeighborTransform(Neighborhood())(batch)
        with torch.random.fork_rng():
            terms = loss(batch.copy())
        parameters = list(loss.actor_network_params.values(True, True))
        norms = {}
        for key in ("loss_actor", "loss_l2c2_actor"):
            gradients = torch.autograd.grad(terms[key], parameters, retain_graph=True)
            norms[key] = torch.cat([g.flatten() for g in gradients]).norm().item()
        share = gradient_shares(loss, batch)["loss_l2c2_actor"]
        assert share == pytest.approx(norms["loss_l2c2_actor"] / norms["loss_actor"], rel=1e-4)

    @pytest.mark.parametrize("fold", [False, True])
    def test_keys_that_were_selected_change_no_share(self, fold):
        """A loop may select the terms that it sums; the penalty is part of them if folded."""
        torch.manual_seed(0)
        case = next(case for case in CASES if case.name == "SAC")
        loss, batch = CAPSLoss(case.make()), case.batch(8)
        loss = loss.fold() if fold else loss
        expected = gradient_shares(loss, batch)
        assert set(expected) == loss.added_terms
        loss.select_out_keys("loss_actor", "loss_qvalue")
        assert gradient_shares(loss, batch) == expected
        assert loss.out_keys == ["loss_actor", "loss_qvalue"]

    def test_measuring_changes_nothing(self):
        """Neither the loss, which keeps a threshold, nor the batch, nor the global generator."""
        torch.manual_seed(0)
        loss = CAPSLoss(PPORPELoss(make_actor(3, 1), make_critic(3)))
        batch = next(case for case in CASES if case.name == "PPO").batch(8)
        batch = batch.select("observation", "next").set("action", torch.zeros(8, 1))
        batch.set("action_log_prob", torch.full((8,), -3.0))
        seen, kept, state = batch.clone(), deepcopy(loss.state_dict()), torch.get_rng_state()
        assert gradient_shares(loss, batch)["loss_caps_spatial"] > 0.0
        assert torch.get_rng_state().equal(state)
        assert all(value.equal(kept[name]) for name, value in loss.state_dict().items())
        assert set(batch.keys(True, True)) == set(seen.keys(True, True))
        assert (batch == seen).all()

    def test_dual_ascent(self):
        """exp(rate * relative excess); no step is larger than the rate; nan changes nothing."""
        gain = TargetGain(2.0, rate=0.5)
        assert gain.step(3.0) == pytest.approx(math.exp(0.25))
        assert gain.step(100.0) == pytest.approx(math.exp(0.75))
        assert gain.step(0.0) == pytest.approx(math.exp(0.25))
        assert gain.step(math.nan) == pytest.approx(math.exp(0.25))

    def test_the_gain_stays_within_its_bounds(self):
        """8 times the first value and an eighth of it."""
        gain = TargetGain(1.0, 1.0, limit=8.0, value=2.0)
        assert [gain.step(1e9) for _ in range(9)][-1] == 16.0
        assert [gain.step(1e-9) for _ in range(9)][-1] == 0.25

    def test_dual_ascent_finds_the_gain_that_meets_the_target(self):
        """Of a measure 1 / (1 + gain), which is 1/4 at the gain 3."""
        gain = TargetGain(0.25, rate=0.1)
        for _ in range(300):
            gain.step(1.0 / (1.0 + gain.value))
        assert gain.value == pytest.approx(3.0, rel=1e-3)

    def test_a_restored_gain_goes_on_as_the_other(self):
        """From its state_dict."""
        gain, again = TargetGain(0.1), TargetGain(0.1)
        gain.step(0.7)
        again.load_state_dict(gain.state_dict())
        assert again.value == gain.value != 1.0
        assert again.step(0.9) == gain.step(0.9)
        with pytest.raises(ValueError, match=r"value must be in \[0.001, 1000\], got 1000000000"):
            again.load_state_dict({"value": 1e9})
        assert again.value == gain.value

    @pytest.mark.parametrize("measured", ["a", None, True])
    def test_what_is_measured_is_a_number(self, measured):
        """Which may be NaN, and then says nothing."""
        with pytest.raises(TypeError, match="measured must be a real number, got"):
            TargetGain(0.1).step(measured)

    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (lambda: TargetGain(0.1, value=0.0), "value must be finite and greater than 0, got 0"),
            (lambda: TargetGain(-0.1), "target must be finite and greater than 0"),
            (lambda: TargetGain(0.1, rate=2.0), r"rate must be in \(0, 1\], got 2"),
            (lambda: TargetGain(0.1, limit=1.0), "limit must be finite and greater than 1"),
        ],
    )
    def test_wrong_settings_are_refused(self, make, message):
        """With what is allowed."""
        with pytest.raises(ValueError, match=message):
            make()


TASK = TaskConfig("pendulum", "Pendulum-v1", episodes=6, max_steps=40)
FEW_UPDATES = dataclasses.replace(ALGORITHMS["ppo_rpe"], replay_ratio=1.0)
KINDS = {
    "ramp": {"gain": "ramp"},
    "target": {"gain": "target", "gain_target": 0.05},
}


def small(regularizer=None, **settings):
    return ExperimentConfig(
        **{
            "task": TASK,
            "algorithm": FEW_UPDATES,
            "regularizer": regularizer or L2C2Config(),
            "replay": UniformReplayConfig(batch_size=8),
            "optimizer": AdamConfig(),
            "compile": False,
            "checkpoint_interval": 0.0,
            **settings,
        }
    )


def timeless(metrics):
    """What does not depend on the clock, as text: nan is nan."""
    return [str({k: v for k, v in row.items() if "per_second" not in k}) for row in metrics]


def assert_continues(config, folder, parted, episodes):
    """A run that is interrupted after some episodes has the whole one's numbers and gains."""
    whole = Experiment(config, folder / "whole")
    whole.train(episodes)
    first = Experiment(config, folder / "parts")
    first.train(parted)
    first.close()
    second = Experiment(config, folder / "parts")
    assert 0 < len(second.metrics) < episodes
    second.train(episodes)
    assert timeless(second.metrics) == timeless(whole.metrics)
    state, expected = second.agent.loss.state_dict(), whole.agent.loss.state_dict()
    assert all((state[name] == value).all() for name, value in expected.items())
    first, last = whole.metrics[0], whole.metrics[-1]
    assert any(first[name] != last[name] for name in first if name.startswith("gain"))


class TestInARun:
    def test_a_constant_gain_adds_nothing_to_the_log(self):
        """Nor do other settings of the gain count then."""
        rows = Experiment(small()).train(1)
        assert not [name for name in rows[0] if name.startswith("gain")]

    def test_a_ramp_follows_the_training_that_was_asked_for(self):
        """0 in the first of six episodes, 5/6 in the last; and the loss has it."""
        run = Experiment(small(L2C2Config(**KINDS["ramp"])))
        rows = run.train(3) and run.train()
        assert [row["gain"] for row in rows] == pytest.approx([k / 6 for k in range(6)])
        assert rows[0]["loss_l2c2_actor"] == 0.0 < rows[-1]["loss_l2c2_actor"]
        assert run.agent.loss.regularizer_gain == 1.0

    def test_a_shorter_ramp_ends_before_the_training_does(self):
        """After half of six episodes; the log has the share of the strength, the loss both."""
        run = Experiment(small(L2C2Config(gain="ramp", gain_length=0.5, strength=2.0)))
        rows = run.train(2)
        assert run.agent.loss.regularizer_gain.item() == pytest.approx(4 / 3)
        rows = run.train()
        assert [row["gain"] for row in rows] == pytest.approx([0, 1 / 3, 2 / 3, 1, 1, 1])
        assert run.agent.loss.regularizer_gain == run.agent.loss.strength == 2.0

    def test_a_longer_training_has_a_longer_ramp_and_its_own_rates(self):
        """Of twelve episodes instead of six; one that had ended begins at a rate above 0."""
        settings = {"optimizer": AdamConfig(linear=True)}
        run = Experiment(small(L2C2Config(**KINDS["ramp"]), **settings))
        rows = run.train(12)
        assert [row["gain"] for row in rows] == pytest.approx([k / 12 for k in range(12)])
        before = [parameter.clone() for parameter in run.agent.loss.parameters()]
        run.train(13)
        after = run.agent.loss.parameters()
        assert not all(torch.equal(a, b) for a, b in zip(after, before, strict=True))

    def test_a_target_is_approached_from_above(self):
        """An action variation far above it lets the gain rise by its rate in every episode."""
        settings = {"gain": "target", "gain_target": 1e-9, "gain_rate": 0.5}
        run = Experiment(small(L2C2Config(**settings)))
        rows = run.train()
        assert [row["gain"] for row in rows] == pytest.approx([math.exp(k / 2) for k in range(6)])
        assert [row["gain_measured"] for row in rows] == [row["action_variation"] for row in rows]
        assert rows[0]["gain_target"] == 1e-9
        assert run.agent.loss.regularizer_gain.item() == pytest.approx(math.exp(3.0))
        assert run.agent.loss.l2c2_beta.item() == pytest.approx(0.1)

    @pytest.mark.parametrize("gain", ["constant", "ramp"])
    def test_the_strength_scales_the_gain_of_a_run(self, gain):
        """At the end of a ramp, or at once."""
        run = Experiment(small(regularizer=L2C2Config(strength=0.5, gain=gain)))
        run.train()
        assert run.agent.loss.regularizer_gain.item() == 0.5

    def test_a_first_call_is_no_loop_without_the_terms(self):
        """Before its first ``backward`` nothing is differentiated yet."""
        case = next(case for case in CASES if case.name == "SAC")
        loss, batch = CAPSLoss(case.make()), case.batch(8)
        loss(batch.copy())
        with warnings.catch_warnings():
            warnings.filterwarnings("error", ".*were never differentiated")
            gradient_shares(loss, batch)

    def test_shares_are_measured_where_no_gradients_are_kept(self):
        """As between updates; terms that are not single numbers are refused."""
        run = Experiment(small())
        run.train()
        batch = run.learner.example()
        expected = gradient_shares(run.agent.loss, batch)
        with torch.no_grad():
            assert gradient_shares(run.agent.loss, batch) == expected
        run.agent.loss.reduction = "none"
        with pytest.raises(ValueError, match="make the loss with reduction='mean'"):
            gradient_shares(run.agent.loss, batch)

    @pytest.mark.parametrize(
        "kind",
        ["target", *(pytest.param(k, marks=pytest.mark.slow) for k in KINDS if k != "target")],
    )
    def test_a_continued_run_is_the_uninterrupted_one(self, tmp_path, kind):
        """Parameters, gains and metrics, to the last bit."""
        assert_continues(small(L2C2Config(**KINDS[kind]), late_share=0.0), tmp_path, 3, 6)

    @pytest.fixture
    def measured_soon(self, monkeypatch):
        """After 20 updates, not 100, it is told which regularizer is faint."""
        monkeypatch.setattr("torchrl_l2c2.experiment.learn.learner.MEASURE_AFTER", 20)

    @pytest.mark.parametrize("kind", ["constant", "ramp", "target"])
    def test_a_gain_that_does_not_rise_by_itself_is_told_to_be_faint(self, kind, measured_soon):
        """Once measured; a ramp by what it ends with, and goes on from where it is."""
        of_kind = {"gain": kind, **({"gain_target": 0.1} if kind == "target" else {})}
        regularizer = L2C2Config(lambda_min=1e-9, lambda_max=1e-8, **of_kind)
        run = Experiment(small(regularizer, algorithm=PPORPEConfig(hidden=(8,), updates=12)))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            run.train(2)
        told = [w for w in caught if "regularizer's terms are below" in str(w.message)]
        assert len(told) == (kind != "target")
        if kind == "ramp":
            assert run.agent.loss.regularizer_gain == run.metrics[-1]["gain_measured"] > 0.0

    def test_what_a_ramp_ends_with_is_looked_at_and_left(self):
        """The loss has the gain of now again, before the next update."""
        run = Experiment(small(L2C2Config(gain="ramp")))
        run.train(1)
        before = run.agent.loss.regularizer_gain.item()
        with run.learner.at_full_gain():
            assert run.agent.loss.regularizer_gain.item() == 1.0 > before
        assert run.agent.loss.regularizer_gain.item() == before

    def test_a_ramp_is_told_by_the_gain_that_it_ends_with(self, measured_soon):
        """Its first updates have none."""
        regularizer = L2C2Config(lambda_min=1.0, lambda_max=100.0, gain="ramp")
        run = Experiment(small(regularizer, algorithm=PPORPEConfig(hidden=(8,), updates=24)))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            run.train(1)

    @pytest.mark.slow
    def test_a_compiled_update_follows_the_gain(self):
        """The term is 0 in the first episode of a ramp and grows with it."""
        run = Experiment(small(L2C2Config(gain="ramp"), compile=True))
        rows = run.train()
        gains = [row["loss_l2c2_actor"] / row["l2c2_hellinger"] for row in rows]
        assert gains[0] == 0.0 and gains == sorted(gains) and gains[-1] > 0


ROLLOUTS = {
    "episodes": {"frames": 80},
    "simulators": {"frames": 100, "num_envs": 2},
    "normalized": {
        **{"frames": 100, "num_envs": 2, "clip_actions": True},
        **{"normalize_observations": True, "normalize_rewards": True},
    },
}


# What is normalized is played by simulators as well.
KINDS_OF_ROLLOUTS = ["episodes", pytest.param("simulators", marks=pytest.mark.slow), "normalized"]


def small_ppo(kind="episodes", **settings):
    """A rollout is forgotten before the gain is set, and several episodes end in it."""
    regularizer = L2C2Config(**{"policy_distance": "mean", **settings})
    return small(
        regularizer,
        algorithm=PPOConfig(hidden=(8,), epochs=1, **ROLLOUTS[kind]),
        replay=RolloutReplayConfig(batch_size=32),
        late_share=0.0,
    )


class TestRollouts:
    @pytest.mark.parametrize("kind", KINDS_OF_ROLLOUTS)
    def test_a_target_is_of_the_rollout_that_was_learned_from(self, kind):
        """Of all its episodes: a single one is noisy, and the first that ends a short one."""
        of_kind = {"gain": "target", "gain_target": 0.1, "gain_rate": 0.5}
        rows = Experiment(small_ppo(kind, **of_kind)).train(16)
        seen, several = [], 0
        for before, row, after in zip([{"updates": 0}, *rows], rows, rows[1:], strict=False):
            seen.append(row["action_variation"])
            assert row["gain_measured"] == pytest.approx(statistics.fmean(seen))
            # Simulators learn before their episodes are handed out, and single episodes after.
            of_rollout = after if kind != "episodes" else before
            if row["updates"] == of_rollout["updates"]:
                assert after["gain"] == row["gain"]
                continue
            excess = min(row["gain_measured"] / 0.1 - 1.0, 1.0)
            assert after["gain"] == pytest.approx(row["gain"] * math.exp(0.5 * excess))
            several += len(seen) > 1
            seen = []
        assert several

    @pytest.mark.parametrize("kind", KINDS_OF_ROLLOUTS)
    def test_a_continued_run_is_the_uninterrupted_one(self, tmp_path, kind):
        """To the last bit, wherever in the rollouts it was interrupted."""
        config = small_ppo(kind, gain="target", gain_target=0.1)
        assert_continues(config, tmp_path, 5, 10)


class TestRefusals:
    @pytest.mark.parametrize(
        ("settings", "message"),
        [
            ({"gain": "target"}, "gain_target must be given with gain=target, got null"),
            (
                {"gain_target": 0.1},
                "gain_target works only with gain=target, got 0.1 .* at null",
            ),
            ({"gain_length": 0.5}, "gain_length works only with gain=ramp, got 0.5 .* at 1.0"),
            ({"gain": "ramp", "gain_rate": 0.5}, "gain_rate works only with gain=target"),
            ({"gain_limit": 10.0}, "gain_limit works only with gain=target"),
            ({"gain": "pid"}, "gain must be 'constant', 'ramp' or 'target'"),
        ],
    )
    def test_settings_that_do_not_go_together_are_refused(self, settings, message):
        """With what would."""
        with pytest.raises(SettingError, match=message):
            L2C2Config(**settings)
