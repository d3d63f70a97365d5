"""Why a policy shakes: what is measured, what is said of it, and the page."""

import re
from contextlib import nullcontext
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
import torch
from small import ALGORITHMS
from tensordict import TensorDict
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.envs import GymEnv, GymWrapper, SerialEnv
from torchrl.modules import Actor, ProbabilisticActor
from torchrl.objectives import BCLoss

from torchrl_l2c2 import Neighborhood
from torchrl_l2c2.experiment import (
    Experiment,
    ExperimentConfig,
    L2C2Config,
    NoRegularizerConfig,
    PPOConfig,
    PPORPEConfig,
    RolloutReplayConfig,
    TaskConfig,
    TD3Config,
    evaluate_policy,
    load_policy,
    make_env,
)
from torchrl_l2c2.experiment.agents.build import make_agent
from torchrl_l2c2.experiment.analysis.diagnosis import (
    THRESHOLDS,
    Diagnosis,
    TermShare,
    comparison,
    diagnose,
    diagnose_actions,
    diagnose_recording,
    diagnose_run,
    findings,
    value_function,
    write_page,
)
from torchrl_l2c2.experiment.analysis.diagnosis.film import film
from torchrl_l2c2.experiment.analysis.diagnosis.names import run_folders, run_names
from torchrl_l2c2.experiment.analysis.diagnosis.page import page
from torchrl_l2c2.experiment.analysis.diagnosis.run import _batch
from torchrl_l2c2.experiment.cli import evaluate
from torchrl_l2c2.experiment.cli.diagnose import main
from torchrl_l2c2.experiment.errors import SimulatorError, UserError
from torchrl_l2c2.experiment.learn.learner import Learner
from torchrl_l2c2.experiment.learn.replay import make_replay
from torchrl_l2c2.experiment.run.files import make_parent_folder, write_json
from torchrl_l2c2.metrics import action_variation, previous_action_gain

STEPS = torch.arange(100.0)
SINE = torch.sin(2 * torch.pi * STEPS / 100).unsqueeze(-1)
FLIPPING = (-1.0) ** STEPS.unsqueeze(-1)


def made_up(actions=0.5 * SINE, **known):
    """A diagnosis of these actions in [-1, 1], with nothing to say of anything else."""
    size = actions.shape[1]
    return Diagnosis(
        **{
            "name": "made up",
            "measures": {
                "return": 1.0,
                "action_variation": action_variation(actions).item(),
                "previous_action_gain": previous_action_gain(actions).item(),
            },
            "actions": actions,
            "low": -torch.ones(size),
            "high": torch.ones(size),
            "bounded": True,
            "observations": torch.arange(float(len(actions)))[:, None] ** torch.tensor([1, 2]),
            "policy_lipschitz": torch.ones(len(actions)),
            "value_lipschitz": None,
            "distance": torch.full((len(actions),), 0.5),
            "neighborhood": Neighborhood(),
            "unmoved": torch.tensor([0.0, 1.0]),
            "held": torch.tensor([0.9, 1.0]),
            "noise_scale": 0.01,
            "noise_action": 0.01,
            "noise_share": 0.1,
            "noise_inputs": torch.tensor([0.5, 0.5]),
            "spread": 0.1,
            "entries": ("speed", "angle"),
            **known,
        }
    )


def kinds(diagnosis):
    return [found.kind for found in findings(diagnosis)]


def said(diagnosis, kind):
    (found,) = [found for found in findings(diagnosis) if found.kind == kind]
    return found


class TestWords:
    """Of made-up episodes."""

    def test_a_slow_sine_is_smooth(self):
        """Which is no fault. Its mean change is 4 amplitudes in a period of 100 steps."""
        found = said(made_up(), "smooth")
        assert kinds(made_up()) == ["smooth"] and not found.fault
        assert "1.0% of its range" in found.text

    def test_an_action_that_alternates_flips(self):
        """By half of the range at every step, at half of 20 Hz."""
        found = said(made_up(0.5 * FLIPPING, rate=20.0), "flips")
        assert kinds(made_up(0.5 * FLIPPING)) == ["flips", "steepest"] and found.fault
        for words in ("10 Hz", "100% of the steps", "50.0% of its range", "throughout"):
            assert words in found.text

    @pytest.mark.parametrize(("period", "hertz"), [(2.5, 12.0), (2.8, 10.7)])
    def test_what_turns_back_nearly_every_step_has_its_own_frequency(self, period, hertz):
        """A gain of -0.5 or less may be an oscillation of three steps, and no flip."""
        action = 0.5 * torch.sin(2 * torch.pi * STEPS / period + 0.1).unsqueeze(-1)
        text = said(made_up(action, rate=30.0), "flips").text
        found = re.search(r"turns back nearly every step, which is shaking at ([\d.]+) Hz, 0", text)
        assert found is not None and float(found[1]) == pytest.approx(hertz, rel=0.03)

    def test_a_fast_oscillation_is_no_noise(self):
        """Of 3.3 steps, with the roughness of noise; half of white noise added to it hides it."""
        noise = torch.randn(100, 1, generator=torch.Generator().manual_seed(0))
        action = 0.5 * torch.sin(2 * torch.pi * STEPS / 3.3).unsqueeze(-1)
        text = said(made_up(action, rate=33.0), "rough").text
        assert "action[0] oscillates, which is shaking at 10 Hz, 0.3 of the control rate" in text
        assert "moves like noise" in said(made_up(0.1 * action + 0.1 * noise), "rough").text

    def test_a_slower_movement_is_not_taken_for_the_shaking(self):
        """Of a joint that walks at 0.5 Hz, with noise or a tone of 18 Hz on top."""
        seconds = torch.arange(1000) / 50
        walk = 0.4 * torch.sin(torch.pi * seconds)
        noise = torch.randn(1000, generator=torch.Generator().manual_seed(0))
        text = said(made_up((walk + 0.08 * noise).unsqueeze(-1), rate=50.0), "rough").text
        assert "moves like noise" in text
        tone = 0.12 * torch.sin(36 * torch.pi * seconds + 0.3 * noise.cumsum(0) / 5)
        text = said(made_up((walk + tone).unsqueeze(-1), rate=50.0), "rough").text
        assert "oscillates, which is shaking at 18" in text

    @pytest.mark.parametrize("steps", [200, 1000, 6000])
    def test_a_frequency_that_varies_is_found_in_recordings_of_any_length(self, steps):
        jitter = torch.randn(steps, generator=torch.Generator().manual_seed(0)).cumsum(0)
        action = 0.2 * torch.sin(2 * torch.pi * 0.38 * torch.arange(steps) + 0.2 * jitter)
        text = said(made_up(action.unsqueeze(-1), rate=50.0), "flips").text
        assert "turns back nearly every step, which is shaking at 19" in text

    @pytest.mark.parametrize("steps", [20, 30, 50, 80])
    def test_short_recordings_of_noise_have_no_frequency(self, steps):
        """In 95 of 100; a clear oscillation of 30 steps has one."""
        generator = torch.Generator().manual_seed(0)
        noise = 0.2 * torch.randn(100, steps, 1, generator=generator)
        texts = [found.text for each in noise for found in findings(made_up(each))]
        assert sum("oscillates" in text or "nearly every step" in text for text in texts) <= 5
        sine = 0.5 * torch.sin(2 * torch.pi * torch.arange(30.0) / 3.3).unsqueeze(-1)
        assert "oscillates, which is shaking at 0.3" in said(made_up(sine), "rough").text

    def test_the_gain_is_that_of_the_action_that_is_named(self):
        hip = 0.3 * torch.sin(2 * torch.pi * STEPS / 8)
        knee = 0.9 * torch.sin(2 * torch.pi * STEPS / 100)
        both = made_up(torch.stack((hip, knee), 1), action_names=("hip", "knee"))
        gain = previous_action_gain(hip.unsqueeze(-1)).item()
        assert gain < 0.9 < previous_action_gain(knee.unsqueeze(-1)).item()
        text = said(both, "moves").text
        assert "hip changes most" in text
        assert f"its gain on the previous action is {gain:.2f};" in text

    def test_an_action_of_another_unit_that_counts_as_still_is_named(self):
        tilt, speed = 0.02 * FLIPPING[:, 0], 5000 + 1000 * torch.sin(STEPS / 20)
        found = diagnose_actions(torch.stack((tilt, speed), 1), action_names=["tilt", "speed"])
        text = said(found, "units").text
        assert "counts as still, as with tilt: if the units differ, give bounds" in text
        assert not [each for each in findings(made_up(FLIPPING)) if each.kind == "units"]

    def test_what_has_no_frequency_of_its_own_flips(self):
        """The changes of white noise have a gain of -0.5, and a beat is none either."""
        noise = torch.randn(1001, 1, generator=torch.Generator().manual_seed(0))
        beat = torch.sin(2 * torch.pi * torch.arange(1000.0) / 2.1).unsqueeze(-1)
        for action in (0.1 * noise.diff(dim=0), 0.5 * beat):
            text = said(made_up(action, rate=30.0), "flips").text
            assert "flips from step to step, which is shaking at 15 Hz, half the control" in text

    def test_flipping_in_one_place_is_said_to_be_there(self):
        """A tenth of the episode; the rest is at rest."""
        actions = torch.zeros(100, 1)
        actions[50:60] = 0.5 * FLIPPING[50:60]
        assert "in steps 50 to 59" in said(made_up(actions), "flips").text

    def test_the_action_that_flips_is_named(self):
        """Beside a smooth one."""
        actions = torch.cat([0.5 * SINE, 0.5 * FLIPPING], 1)
        assert said(made_up(actions), "flips").text.startswith("action[1]")

    def test_a_short_recording_chatters_as_a_long_one_does(self):
        """A sine of 30 Hz at 200 Hz; four periods are enough."""
        time = torch.arange(400.0) / 200
        action = torch.sin(2 * torch.pi * 30 * time).unsqueeze(-1)
        for length in (30, 60, 99, 400):
            found = diagnose_actions(action[:length], bounds=(-1.5, 1.5), rate=200.0)
            assert "chatters" in kinds(found)

    def test_where_nothing_is_steep_no_step_is_steepest(self):
        flat = made_up(0.5 * FLIPPING, policy_lipschitz=torch.zeros(len(FLIPPING)))
        assert flat.worst() == [] and kinds(flat) == ["flips"]

    def test_many_actions_with_one_fault_share_a_finding(self):
        """Two have a sentence each; with three, one sentence names all, the largest first."""
        sizes = torch.tensor([0.3, 0.5, 0.4])
        found = said(made_up(sizes * FLIPPING), "flips")
        assert found.text.startswith("action[1]")
        assert found.text.endswith("The same holds for 2 other actions: action[2], action[0].")
        assert kinds(made_up(sizes[:2] * FLIPPING))[:2] == ["flips", "flips"]

    def test_where_it_is_steepest_is_told_in_what_it_observes(self):
        """Of a policy that shakes; steps are the first entry here, their squares the second."""
        constants = torch.ones(100)
        constants[7] = 6.0
        found = said(made_up(0.5 * FLIPPING, policy_lipschitz=constants), "steepest")
        assert "at step 7, where it observes speed = 7, angle = 49: " in found.text
        assert "is 6 there and 1 in the median" in found.text and not found.fault

    def test_of_many_inputs_those_are_told_that_the_action_follows(self):
        """Four of nine, the one with the largest effect first; without effects the first eight."""
        known = {"observations": torch.arange(9.0).expand(100, 9), "entries": tuple("abcdefghi")}
        held = torch.tensor([0.8, 1.0, 1.0, 0.9, 1.0, 1.0, 1.0, 0.7, 1.2])
        found = said(made_up(0.5 * FLIPPING, held=held, **known), "steepest")
        assert "where it observes h = 7, a = 0, d = 3, b = 1, ...: " in found.text
        found = said(made_up(0.5 * FLIPPING, held=torch.empty(0), **known), "steepest")
        assert "where it observes a = 0, b = 1, " in found.text and "h = 7, ...: " in found.text

    @pytest.mark.parametrize(
        ("ratio", "differs"), [(0.5, True), (0.6, False), (1.9, False), (2.0, True)]
    )
    def test_a_first_episode_that_is_unlike_the_mean_is_said_to_be(self, ratio, differs):
        """First of all, because the other findings describe that episode."""
        fast = torch.sin(6 * torch.pi * STEPS / 100).unsqueeze(-1)
        known = made_up(fast).measures
        mean = {**known, "action_variation": ratio * known["action_variation"]}
        assert kinds(made_up(fast, measures=mean)) == ["unlike"] * differs + ["moves"]

    @pytest.mark.parametrize(("ratio", "said"), [(0.1, False), (3.9, False), (4.1, True)])
    def test_smooth_episodes_may_differ(self, ratio, said):
        """A change of 0.5% of the range is smooth, and up to four times as much is too."""
        ramp = torch.linspace(0.0, 0.99, 100).unsqueeze(-1)
        known = made_up(ramp).measures
        mean = {**known, "action_variation": ratio * known["action_variation"]}
        assert kinds(made_up(ramp, measures=mean)) == ["unlike"] * said + ["smooth"]

    def test_a_first_episode_at_rest_does_not_hide_the_others(self):
        """A policy that shakes only after some starts."""
        still = made_up(torch.zeros(100, 1))
        shaking = {**still.measures, "action_variation": 0.3}
        assert kinds(still) == ["still"]
        assert kinds(made_up(torch.zeros(100, 1), measures=shaking)) == ["unlike", "still"]
        assert "is 0.3." in findings(made_up(torch.zeros(100, 1), measures=shaking))[0].text

    def test_a_square_wave_is_bang_bang(self):
        """From bound to bound every ten steps: nine jumps in a hundred steps."""
        square = torch.where((STEPS // 10) % 2 == 0, 1.0, -1.0).unsqueeze(-1)
        assert kinds(made_up(square)) == ["bang-bang", "steepest"]
        text = said(made_up(square), "bang-bang").text
        assert "in 100% of the steps" in text and "9 times, one in 11 steps" in text

    def test_without_bounds_nothing_is_bang_bang_or_wide(self):
        """Or wide: the largest action that was seen is no bound."""
        square = torch.where((STEPS // 10) % 2 == 0, 1.0, -1.0).unsqueeze(-1)
        assert not {"bang-bang", "wide"} & set(kinds(made_up(square, bounded=False, spread=0.9)))

    def test_one_bound_is_pinned(self):
        """What moves in four tenths of the steps is no jumping between bounds."""
        actions = torch.where(STEPS < 60, 1.0, 0.5 * SINE[:, 0]).unsqueeze(-1)
        assert "pinned at its upper bound in 60%" in said(made_up(actions), "pinned").text

    def test_an_action_that_never_leaves_its_bound_is_pinned(self):
        """Beside one that moves."""
        actions = torch.cat((0.5 * SINE, torch.ones(len(SINE), 1)), -1)
        assert "pinned at its upper bound in 100%" in said(made_up(actions), "pinned").text

    def test_short_episodes_have_no_fast_frequencies(self):
        for steps in range(4, 12):
            actions = 0.1 * torch.linspace(0, 1, steps).square().unsqueeze(-1)
            assert findings(made_up(actions))

    def test_names_of_actions_are_no_formulas(self):
        """Nor hidden from the legend."""
        actions = torch.cat((SINE, SINE.roll(9)), -1)
        shown = page([diagnose_actions(actions, action_names=["$\\torque$", "_hip"])])
        assert "$\\torque$" in shown and "_hip" in shown

    def test_a_constant_action_stands_still(self):
        """Nothing else is said of it, but of its training."""
        still = made_up(torch.full((100, 1), 0.3) + 1e-4 * SINE, noise_share=1.0, spread=0.9)
        assert kinds(still) == ["still"] and "(0.3)" in findings(still)[0].text

    def test_white_noise_is_rough(self):
        """Its roughness is a quarter of the rate."""
        noise = torch.rand(100, 1, generator=torch.Generator().manual_seed(0)) - 0.5
        found = said(made_up(noise), "rough")
        assert abs(float(re.search(r"roughness is ([\d.]+)", found.text)[1]) - 0.25) < 0.03

    @pytest.mark.parametrize(
        ("rate", "cycles", "speed"),
        [(50.0, 0.5, "about 25 Hz"), (50.0, 0.2, "about 10 Hz"), (None, 0.4, "about 0.4 of the")],
    )
    def test_shaking_around_a_slow_movement_chatters(self, rate, cycles, speed):
        """With the frequency and the size of the fast part: that of a sine over root 2."""
        steps = torch.arange(500.0).unsqueeze(-1)
        slow = 0.5 * torch.sin(2 * torch.pi * steps / 250)
        fast = 0.2 * torch.cos(2 * torch.pi * cycles * steps)
        found = said(made_up(slow + fast, action_names=["knee"], rate=rate), "chatters")
        assert found.text.startswith("knee chatters") and found.fault and speed in found.text
        size = fast.square().mean().sqrt().item() / 2
        assert f"by {size:.1%} of its range" in found.text and "throughout" in found.text
        assert kinds(made_up(slow + 0.1 * fast, rate=rate)) == ["smooth"]

    def test_what_has_no_slower_movement_oscillates(self):
        action = 0.3 * torch.sin(2 * torch.pi * 9 * torch.arange(500.0) / 50).unsqueeze(-1)
        text = said(made_up(action, action_names=["knee"], rate=50.0), "chatters").text
        assert text.startswith("knee oscillates, which is shaking at about 9 Hz")

    def test_a_tenth_of_an_episode_may_chatter(self):
        """It stands still otherwise; the sentence has the steps."""
        actions = torch.zeros(1000, 1)
        actions[700:800] = 0.06 * (-1.0) ** torch.arange(100).unsqueeze(-1)
        actions += 0.5 * torch.sin(2 * torch.pi * torch.arange(1000) / 500).unsqueeze(-1)
        found = re.search(r"in steps (\d+) to (\d+)", said(made_up(actions), "chatters").text)
        assert 700 <= int(found[1]) < int(found[2]) < 800

    def test_the_end_of_an_episode_may_chatter(self):
        """Also what is left if the parts do not fill it: 19 of 52 steps, and 42."""
        steps = torch.arange(1030).unsqueeze(-1)
        actions = 0.5 * torch.sin(2 * torch.pi * steps / 515)
        actions[988:] += 0.06 * (-1.0) ** steps[988:]
        assert said(made_up(actions), "chatters").text.endswith("in steps 978 to 1029.")

    @pytest.mark.parametrize("rate", [None, 50.0, 500.0])
    @pytest.mark.parametrize("shape", ["sine", "steps", "sawtooth", "clipped", "noisy"])
    def test_slow_movement_does_not_chatter(self, shape, rate):
        """Whose spectrum has a tail: jumps, corners, and a little noise."""
        steps = torch.arange(2000.0).unsqueeze(-1)
        sine = torch.sin(2 * torch.pi * steps / 400)
        actions = {
            "sine": 0.9 * sine,
            "steps": 0.5 * sine.sign(),
            "sawtooth": (steps / 400) % 1 - 0.5,
            "clipped": (2 * sine).clamp(-0.5, 0.5),
            "noisy": 0.5 * sine
            + 0.01 * torch.randn(2000, 1, generator=torch.Generator().manual_seed(0)),
        }[shape]
        assert "chatters" not in kinds(made_up(actions, rate=rate))

    def test_the_action_that_moves_most_is_named_first(self):
        """Also if nothing is wrong; actions that stand still are no part of the number."""
        still = torch.full((100, 3), 0.3)
        found = said(made_up(torch.cat([still, 0.5 * SINE], 1)), "smooth")
        assert "action[3] changes most, by 1.0% of its range" in found.text
        both = torch.cat([0.2 * FLIPPING, 0.5 * FLIPPING], 1)
        assert findings(made_up(both))[0].text.startswith("action[1] flips")

    def test_fast_and_even_moves_are_neither_smooth_nor_a_fault(self):
        """Ten sines of half the range."""
        found = findings(made_up(0.5 * torch.sin(2 * torch.pi * STEPS / 10).unsqueeze(-1)))
        assert [(each.kind, each.fault) for each in found] == [("moves", False)]

    @pytest.mark.parametrize(
        ("kind", "name", "known"),
        [
            ("noise", "NOISY", lambda value: {"noise_share": value}),
            ("wide", "WIDE", lambda value: {"spread": value}),
            (
                "steep",
                "STEEP",
                lambda value: {"policy_lipschitz": torch.tensor([1.0] * 99 + [value])},
            ),
        ],
    )
    def test_reasons_are_told_from_their_thresholds_on(self, kind, name, known):
        """Of a policy that moves much."""
        fast = 0.5 * torch.sin(2 * torch.pi * STEPS / 10).unsqueeze(-1)
        threshold = THRESHOLDS[name][0]
        assert kind in kinds(made_up(fast, **known(threshold)))
        assert kind not in kinds(made_up(fast, **known(0.99 * threshold)))

    def test_the_input_with_most_of_the_effect_of_noise_is_named(self):
        """If it has the threshold's share; a policy has no other input than its only one."""
        fast = 0.5 * torch.sin(2 * torch.pi * STEPS / 10).unsqueeze(-1)
        known = {"noise_share": 0.6}
        most = torch.tensor([0.4, 0.6])
        text = said(made_up(fast, noise_inputs=most, **known), "noise").text
        assert text.endswith("change from step to step. Noise on angle has 60% of the effect.")
        third = torch.full((3,), 1 / 3)
        for unknown in (third, torch.ones(1), torch.empty(0), torch.full((2,), torch.nan)):
            text = said(made_up(fast, noise_inputs=unknown, **known), "noise").text
            assert text.endswith("of the squared change from step to step.")

    def test_the_input_that_an_action_follows_is_named(self):
        """If it moves much, from the threshold on."""
        fast = 0.5 * torch.sin(2 * torch.pi * STEPS / 10).unsqueeze(-1)
        follows = torch.tensor([1.1, THRESHOLDS["FOLLOWS"][0]])
        finding = said(made_up(fast, held=follows), "input")
        assert "one input, angle: " in finding.text and "change 50% less" in finding.text
        assert not finding.fault
        assert "input" not in kinds(made_up(fast, held=1.01 * follows))
        assert "input" not in kinds(made_up(torch.zeros_like(fast), held=follows))
        assert "input" not in kinds(made_up(fast, held=torch.full((2,), torch.nan)))

    def test_a_faint_regularizer_is_told_by_its_gradients(self):
        """Sizes count where there are no gradients; terms of the loss itself never do."""
        own = {"actor": TermShare(added=False, size=1e-5)}
        faint, strong = TermShare(True, 0.5, 1e-4), TermShare(True, 1e-5, 0.5)
        assert (
            "l2c2_actor 0.01% of the gradient"
            in said(made_up(shares={**own, "l2c2_actor": faint}), "small").text
        )
        assert "small" not in kinds(made_up(shares={**own, "l2c2_actor": strong}))
        assert "small" not in kinds(made_up(shares={**own, "caps": TermShare(True, 0.1)}))
        by_size = said(made_up(shares={**own, "caps": TermShare(True, 5e-4)}), "small")
        assert "caps 0.05% of the loss" in by_size.text and by_size.fault
        assert by_size.text.endswith("raise their gains.")
        none = said(made_up(shares={"l2c2_actor": TermShare(True, 0.0, 0.0)}), "small")
        assert "change nothing; raise max_step if" in none.text
        both = said(made_up(shares={"a": faint, "b": strong}), "small")
        assert both.text.startswith("Some") and not both.fault


def test_policies_are_compared_with_the_first():
    """By the paper's measure and the return."""
    measured = {"previous_action_gain": 1.0}
    first, second, third, fourth = (
        made_up(name=name, measures={**measured, "return": r, "action_variation": v})
        for name, r, v in (
            ("one", -200.0, 0.4),
            ("two", -100.0, 0.1),
            ("three", -200.0, 0.5),
            ("four", -300.0, 4.0),
        )
    )
    assert comparison([first]) == []
    assert comparison([first, second, third, fourth]) == [
        "two changes its action 75% less from step to step than one (0.1, 0.4), and its return is "
        "higher (-100, -200).",
        "three changes its action 25% more from step to step than one (0.5, 0.4), and its return "
        "is the same (-200, -200).",
        "four changes its action 10 times as much from step to step as one (4, 0.4), and its "
        "return is lower (-300, -200).",
    ]


class Walk(gymnasium.Env):
    """One coordinate goes up by .1 at every step, the other stays."""

    observation_space = gymnasium.spaces.Box(-9, 9, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-4, 4, (1,), np.float32)

    length = 10

    def _seen(self):
        return np.array([0.1 * self.steps, 0.7], np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self._seen(), {}

    def step(self, action):
        self.steps += 1
        return self._seen(), 2.0, False, self.steps == self.length, {}


def linear(slope):
    """A deterministic policy: this slope times the first coordinate."""
    return TensorDictModule(
        lambda observation: slope * observation[..., :1], ["observation"], ["action"]
    )


class TestMeasured:
    """Against numbers known by hand."""

    def test_a_linear_policy_has_its_slope_everywhere(self):
        """So has a linear value function; the second coordinate has no neighbors."""
        found = diagnose(
            linear(3.0), GymWrapper(Walk()), value=lambda o, a: 5 * o[:, 0], episodes=2
        )
        for constants, slope in ((found.policy_lipschitz, 3.0), (found.value_lipschitz, 5.0)):
            torch.testing.assert_close(constants, torch.full((10,), slope), rtol=1e-3, atol=0.0)
        assert found.unmoved.tolist() == [0.0, 1.0]
        assert found.measures["return"] == 20.0 and found.measures["length"] == 10.0
        assert found.measures["action_variation"] == pytest.approx(0.3, rel=1e-5)
        assert found.spread == 0.0 and found.low.tolist() == [-4.0] and found.bounded

    def test_a_policy_in_double_precision_keeps_it(self):
        """As its layers ask for; the numbers are the same."""

        class Fine(Walk):
            observation_space = gymnasium.spaces.Box(-9, 9, (2,), np.float64)

            def _seen(self):
                return super()._seen().astype(np.float64)

        layer = nn.Linear(2, 1, bias=False, dtype=torch.float64)
        layer.weight.data = torch.tensor([[3.0, 0.0]], dtype=torch.float64)
        policy = TensorDictModule(layer, ["observation"], ["action"])
        found = diagnose(policy, GymWrapper(Fine()), episodes=1)
        expected = torch.full((10,), 3.0)
        torch.testing.assert_close(found.policy_lipschitz.float(), expected, rtol=1e-3, atol=0.0)
        assert "observation[0]: 100%" in page([found])

    def test_the_action_follows_the_coordinate_that_the_policy_reads(self):
        """Held, it leaves no change; the other coordinate leaves all of it."""
        found = diagnose(linear(3.0), GymWrapper(Walk()), episodes=1)
        assert found.held.tolist() == pytest.approx([0.0, 1.0], abs=1e-6)
        assert "observation[0]: 100%" in page([found]) and "Inputs that the action" in page([found])
        assert "Inputs that the action" not in page([replace(found, held=torch.empty(0))])

    def test_changes_of_several_actions_are_relative_to_their_ranges(self):
        """An action with a hundredth of the range changes by a hundredth, which is as much."""

        class Stroll(Walk):
            action_space = gymnasium.spaces.Box(*np.float32([[-4, -0.04], [4, 0.04]]))

            def _seen(self):
                return np.array([0.1 * self.steps, -0.1 * self.steps], np.float32)

        both = TensorDictModule(
            lambda seen: seen * torch.tensor([1.0, 0.01]), ["observation"], ["action"]
        )
        found = diagnose(both, GymWrapper(Stroll()), episodes=1)
        assert found.held.tolist() == pytest.approx([0.5**0.5] * 2, rel=1e-4)
        assert found.noise_inputs.tolist() == pytest.approx([0.5, 0.5], abs=0.1)
        # Of noise in the second coordinate, which moves the small action by half of its change.
        noise = torch.tensor([0.0, 0.05])
        found = diagnose(both, GymWrapper(Stroll()), episodes=1, noise_scale=noise)
        assert found.noise_share == pytest.approx(2 * 0.05**2 / (2 * 0.1**2), rel=0.5)

    def test_noise_passes_through_the_inputs_by_their_squared_slopes(self):
        """Of 2 and 1: four fifths and one fifth."""
        both = TensorDictModule(
            lambda seen: seen @ torch.tensor([[2.0], [1.0]]), ["observation"], ["action"]
        )
        walk = Walk()
        walk.length = 2000
        found = diagnose(both, GymWrapper(walk), episodes=1, max_steps=2000)
        assert found.noise_inputs.tolist() == pytest.approx([0.8, 0.2], abs=0.02)
        assert "Inputs that pass on noise" in page([found])

    def test_each_input_may_have_noise_of_its_own(self):
        """Slopes of 2 and 1 with deviations of 0.1 and 0.4: one fifth and four fifths."""
        both = TensorDictModule(
            lambda seen: seen @ torch.tensor([[2.0], [1.0]]), ["observation"], ["action"]
        )
        walk = Walk()
        walk.length = 2000
        env, played = GymWrapper(walk), {"episodes": 1, "max_steps": 2000}
        scale = torch.tensor([0.1, 0.4])
        found = diagnose(both, env, noise_scale=scale, **played)
        assert found.noise_inputs.tolist() == pytest.approx([0.2, 0.8], abs=0.02)
        assert found.noise_action == pytest.approx((0.2**2 + 0.4**2) ** 0.5, rel=0.05)
        shaking = replace(found, actions=0.5 * FLIPPING, noise_share=0.9)
        assert "the given noise moves the action by 0.4" in said(shaking, "noise").text
        assert "(of each input)" in page([found])
        for wrong in (torch.ones(3), torch.tensor([0.1, -0.1])):
            with pytest.raises(ValueError, match="noise_sensitivity: scale must"):
                diagnose(both, env, noise_scale=wrong, **played)

    def test_actions_and_inputs_may_have_names(self):
        """Which the findings use; as many as there are."""
        named = {"action_names": ["push"], "observation_names": ["place", "wall"]}
        found = diagnose(linear(3.0), GymWrapper(Walk()), episodes=1, **named)
        assert found.action_name(0) == "push" and "place: 100%" in page([found])
        for argument in named:
            with pytest.raises(UserError, match=f"{argument} must have a name for each of the .*3"):
                diagnose(linear(3.0), GymWrapper(Walk()), episodes=1, **{argument: ["a", "b", "c"]})

    def test_images_are_not_held_one_pixel_at_a_time(self, monkeypatch):
        """It would take an evaluation of every pixel."""
        monkeypatch.setattr("torchrl_l2c2.experiment.analysis.diagnosis.measured.MOST_INPUTS", 1)
        assert not len(diagnose(linear(3.0), GymWrapper(Walk()), episodes=1).held)

    def test_an_action_value_sees_the_action_of_the_state(self):
        """At all of its neighbors: of the action times the state, the slope is the action."""
        found = diagnose(linear(3.0), GymWrapper(Walk()), value=lambda o, a: a * o[:, :1])
        expected = 0.3 * torch.arange(10.0)
        torch.testing.assert_close(found.value_lipschitz, expected, rtol=1e-3, atol=1e-6)

    def test_noise_moves_the_action_by_the_slope(self):
        """3 * .01; two draws of it, of the variance 2 * .03^2, beside steps of .3."""
        walk = Walk()
        walk.length = 1000
        found = diagnose(linear(3.0), GymWrapper(walk), episodes=1, noise_scale=0.01)
        assert found.noise_action == pytest.approx(0.03, rel=0.1)
        assert found.noise_share == pytest.approx(2 * found.noise_action**2 / 0.3**2, rel=1e-3)

    def test_distances_and_gains_are_those_of_the_neighborhood(self):
        """Which is drawn from all of, and whose gain at a distance of zero is the largest."""
        near = Neighborhood(sigma=0.5, lambda_min=0.1, lambda_max=2.0)
        found = diagnose(linear(3.0), GymWrapper(Walk()), neighborhood=near, num_neighbors=200)
        assert found.distance.min() >= 0.0 and found.distance.max() <= near.radius
        assert found.distance.max() > 0.99 * near.radius
        assert near.lambda_min <= found.gain.min() + 1e-6 and found.gain.max() <= near.lambda_max
        at_center = replace(found, distance=torch.zeros(1))
        assert at_center.gain.item() == pytest.approx(near.lambda_max)

    def test_the_spread_is_that_of_the_samples(self):
        """Of a standard deviation of .4 in a range of four to either side."""
        module = nn.Sequential(nn.Linear(2, 2), NormalParamExtractor("relu"))
        nn.init.zeros_(module[0].weight)
        module[0].bias.data = torch.tensor([0.0, 0.4])
        policy = ProbabilisticActor(
            TensorDictModule(module, ["observation"], ["loc", "scale"]),
            in_keys=["loc", "scale"],
            distribution_class=torch.distributions.Normal,
        )
        before = torch.get_rng_state()
        found = diagnose(policy, GymWrapper(Walk()))
        assert found.spread == pytest.approx(0.1, rel=0.1)
        assert torch.equal(before, torch.get_rng_state())
        # One of 400 is at one of the bounds nearly always: by the task's hand, not the policy's.
        module[0].bias.data = torch.tensor([0.0, 400.0])
        assert diagnose(policy, GymWrapper(Walk())).spread == pytest.approx(1.0, rel=0.1)

    def test_the_worst_states_are_places_apart(self):
        """In time and among the states; the second largest is beside the largest."""
        constants = torch.ones(100)
        constants[[30, 31, 70, 90]] = torch.tensor([9.0, 8.0, 7.0, 6.0])
        observations = torch.stack([STEPS, STEPS], 1)
        observations[90] = observations[30]
        found = made_up(policy_lipschitz=constants, observations=observations)
        assert found.worst(2) == [30, 70] and 90 not in found.worst(5)

    def test_a_short_episode_does_not_show_how_an_action_shakes(self):
        (found,) = findings(diagnose(linear(1.0), GymWrapper(Walk())))
        assert found.kind == "short" and "has 10 steps, and fewer than 20" in found.text

    def test_what_cannot_be_diagnosed_is_refused(self):
        """An id, a batch of environments, two observations, an episode that is hardly one."""
        with pytest.raises(TypeError, match=r"environment of TorchRL, got 'Walk-v0': .*GymEnv"):
            diagnose(linear(1.0), "Walk-v0")
        with pytest.raises(ValueError, match="got a batch of \\(2,\\)"):
            diagnose(linear(1.0), SerialEnv(2, lambda: GymWrapper(Walk())))
        two = TensorDictModule(lambda a, b: a, ["observation", "other"], ["action"])
        with pytest.raises(ValueError, match=r"reads \['observation', 'other'\]"):
            diagnose(two, GymWrapper(Walk()))
        recurrent = TensorDictModule(lambda a, b: a, ["observation", "is_init"], ["action"])
        with pytest.raises(ValueError, match=r"a recurrent policy.* diagnose_actions"):
            diagnose(recurrent, GymWrapper(Walk()))
        with pytest.raises(ValueError, match="3 steps is too short"):
            diagnose(linear(1.0), GymWrapper(Walk()), max_steps=3)
        with pytest.raises(FloatingPointError, match="action is not finite at frame 1 of a test"):
            diagnose(linear(float("nan")), GymWrapper(Walk()))

    def test_discrete_actions_are_measured_too(self):
        """A pole that is pushed by turns."""
        env = GymEnv("CartPole-v1")

        def by_turns(observation):
            left = (observation[..., 3:] < 0).long()
            return torch.cat([left, 1 - left], -1)

        found = diagnose(TensorDictModule(by_turns, ["observation"], ["action"]), env)
        assert found.actions.shape[1] == 2 and not found.bounded and found.rate == 50.0
        assert not {"bang-bang", "pinned"} & set(kinds(found))
        assert found.actions.sum(1).eq(1).all()


@pytest.mark.parametrize(("algorithm", "heads"), [(PPORPEConfig(), 5), (TD3Config(), 2)])
def test_the_value_function_is_the_losss(algorithm, heads):
    """Of all heads, or of both networks of a pair, at any actions."""
    config = ExperimentConfig(
        task=TaskConfig("task", "Pendulum-v1", episodes=1), algorithm=algorithm, compile=False
    )
    loss = make_agent(config, make_env(config.task, 0)).loss
    observation, action = torch.randn(7, 3), torch.randn(7, 1)
    batch = TensorDict({"observation": observation, "action": action}, [7])
    value = value_function(loss)(observation, action)
    assert value.shape == (7, heads)
    network = "critic_network" if heads == 5 else "qvalue_network"
    params, net = getattr(loss, f"{network}_params"), getattr(loss, network)
    with torch.no_grad():
        if heads == 5:
            with params.to_module(net):
                expected = net(batch)["state_value_heads"]
        else:
            each = []
            for number in range(heads):
                with params[number].to_module(net):
                    each.append(net(batch.copy())["state_action_value"])
            expected = torch.cat(each, 1)
    torch.testing.assert_close(value, expected)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Of a pendulum, with L2C2."""
    return trained(tmp_path_factory.mktemp("runs") / "l2c2")


@pytest.fixture(scope="module")
def blank(tmp_path_factory):
    """Of a task that draws nothing."""
    return trained(tmp_path_factory.mktemp("runs") / "blank", "Blank-v0")


def trained(folder, env_id="Pendulum-v1"):
    config = ExperimentConfig(
        task=TaskConfig("task", env_id, episodes=4, max_steps=40, noise_scale=0.05),
        algorithm=ALGORITHMS["ppo_rpe"],
        regularizer=L2C2Config(sigma=0.5),
        compile=False,
        late_share=0.0,
    )
    experiment = Experiment(config, folder)
    experiment.train()
    experiment.save()
    experiment.close()
    return folder


class TestRun:
    """A run's folder has all of it."""

    def test_it_plays_the_test_episodes(self, run):
        """The same as ``evaluate`` on the same seed and noise."""
        found = diagnose_run(run, seed=5, episodes=2, with_pictures=False)
        policy, env, steps = load_policy(run, seed=5)
        expected = evaluate_policy(policy, env, 2, max_steps=steps).summary()
        assert found.measures["return"] == pytest.approx(expected["return_mean"], rel=1e-5)
        assert found.measures["roughness"] == pytest.approx(expected["roughness_mean"], rel=1e-4)

    def test_neighborhood_noise_and_shares_are_the_runs_own(self, run):
        """Gradients are known of what the regularizer has added, sizes of every term."""
        found = diagnose_run(run, with_pictures=False)
        assert found.neighborhood.sigma == 0.5 and found.noise_scale == 0.05
        assert found.value_lipschitz.shape == (40,)
        added = {name for name, share in found.shares.items() if share.added}
        assert added == {"l2c2_actor", "l2c2_critic"} and {"actor", "critic"} < set(found.shares)
        assert all(found.shares[name].gradient > 0.0 for name in added)
        assert sum(share.size for share in found.shares.values()) == pytest.approx(1.0)

    def test_the_gain_is_that_of_the_runs_end(self, tmp_path):
        """Where it set itself, the shares of the gradients are with it."""
        shares = {}
        for target in (1e3, 1e-9):
            regularizer = L2C2Config(gain="target", gain_target=target, gain_rate=1.0)
            task = TaskConfig("pendulum", "Pendulum-v1", episodes=3, max_steps=40)
            config = ExperimentConfig(task, ALGORITHMS["ppo_rpe"], regularizer, compile=False)
            experiment = Experiment(config, tmp_path / str(target))
            experiment.train()
            experiment.finish(experiment.test(1))
            experiment.close()
            found = diagnose_run(tmp_path / str(target), episodes=1, with_pictures=False)
            shares[target] = found.shares["l2c2_actor"].gradient
        assert shares[1e-9] > 10 * shares[1e3]

    @pytest.mark.filterwarnings("ignore:all transitions of the batch")
    @pytest.mark.parametrize("normalize", [True, False])
    def test_the_largest_step_is_left_out_where_it_is_of_normalized_observations(
        self, tmp_path, normalize
    ):
        """In standard deviations it means nothing for the observations that the policy reads."""
        more = {"clip_actions": True, "log_scale": 0.0, "normalize_observations": normalize}
        experiment = Experiment(
            ExperimentConfig(
                task=TaskConfig("task", "Pendulum-v1", episodes=2, max_steps=40),
                algorithm=replace(ALGORITHMS["ppo"], num_envs=2, **more),
                regularizer=L2C2Config(max_step=1e-6),
                replay=RolloutReplayConfig(batch_size=16),
                compile=False,
                late_share=0.0,
            ),
            tmp_path,
        )
        experiment.train()
        experiment.save()
        experiment.close()
        found = diagnose_run(tmp_path, episodes=1, with_pictures=False)
        assert found.distance.isfinite().all() == normalize
        assert found.policy_lipschitz.isnan().all() == (not normalize)

    def test_gradients_are_of_what_training_learns_from(self, monkeypatch):
        """Rewards of 1, 50 and -200 are cut off at 10 before they are scaled by .01."""
        algorithm = PPOConfig(
            **{"hidden": (8,), "frames": 64, "num_envs": 2, "clip_actions": True},
            **{"normalize_observations": True, "normalize_rewards": True, "reward_scale": 0.01},
        )
        task = TaskConfig("pendulum", "Pendulum-v1", episodes=2, max_steps=3)
        config = ExperimentConfig(
            task=task, algorithm=algorithm, replay=RolloutReplayConfig(batch_size=16)
        )
        env = make_env(task, 0)
        agent, episode = make_agent(config, env), env.rollout(3, auto_reset=True)
        episode["next", "reward"] = torch.tensor([[1.0], [50.0], [-200.0]])
        monkeypatch.setattr(
            "torchrl_l2c2.experiment.analysis.diagnosis.run.play_episodes",
            lambda *_, **__: [episode],
        )
        learned, read = [], _batch(agent, config, env, 3)
        learner = Learner(agent, make_replay(config, agent.loss), reward_factor=0.01, compile=False)
        monkeypatch.setattr(learner.replay, "extend", learned.append)
        learner.remember(agent.normalization.normalized(episode))
        expected = torch.tensor([[0.01], [0.1], [-0.1]])
        for batch in (read, learned[0]):
            torch.testing.assert_close(batch["next", "reward"], expected)

    @pytest.mark.parametrize(
        "error",
        [
            gymnasium.error.DependencyNotInstalled("pygame is not installed"),
            ValueError("Still-v0 cannot render pictures"),
            SimulatorError("Still-v0 could not start: no graphics library"),
        ],
    )
    def test_pictures_are_left_out_where_they_cannot_be_drawn(self, run, monkeypatch, error):
        """All else is there."""

        def missing(*args, **kwargs):
            raise error

        monkeypatch.setattr("torchrl_l2c2.experiment.analysis.diagnosis.run.play_pictures", missing)
        with pytest.warns(UserWarning, match=f"there is no video: {error}"):
            assert diagnose_run(run, episodes=1).pictures == []


def table_file(path, *lines):
    path.write_text("\n".join(lines) + "\n")
    return path


class TestRecording:
    """Of a robot, or of a policy elsewhere: only the actions are known."""

    def test_it_is_measured_as_an_episode_is(self):
        """By hand: two actions that change by 0.3 and 0.4, so by 0.5, and by the same back."""
        actions = torch.tensor([[0.0, 0.0], [0.3, 0.4]]).repeat(10, 1)
        found = diagnose_actions(actions, bounds=(-1.0, 0.4))
        assert found.measures["action_variation"] == pytest.approx(0.5)
        assert found.measures["length"] == 20 and "return" not in found.measures
        assert found.bounded and found.low.tolist() == [-1.0] * 2
        assert kinds(found) == ["pinned", "flips", "flips"]
        spanned = diagnose_actions(actions)
        assert not spanned.bounded and spanned.high.tolist() == pytest.approx([0.3, 0.4])

    def test_a_spike_does_not_hide_an_action(self):
        """Nor does one that only rounding moves count; one in 200 samples is no span."""
        steps = torch.arange(1000.0)
        actions = torch.stack([0.5 * (-1.0) ** steps, 0.3 + 1e-6 * (-1.0) ** steps], 1)
        actions[500, 0] = 50.0
        first, units = findings(diagnose_actions(actions))
        assert first.text.startswith("action[0] flips") and units.kind == "units"

    @pytest.mark.parametrize("often", [1, 2, 10])
    def test_a_faster_logger_does_not_hide_shaking(self, often):
        """Every action is there several times, of many also once more or less."""
        flips = torch.cat([0.5 * FLIPPING, 0.1 * SINE], 1)
        counts = torch.full((100,), often)
        if often == 10:
            counts += torch.arange(100) % 3 - 1
        logged = flips.repeat_interleave(counts, 0)
        told = f"every action {len(logged) / 100:.3g} times"
        with nullcontext() if often == 1 else pytest.warns(UserWarning, match=told):
            found = diagnose_actions(logged, rate=20.0 * often)
        assert torch.equal(found.actions, flips) and found.rate == pytest.approx(20.0, rel=2e-3)

    @pytest.mark.parametrize("rate", [75.0, 120.0, 240.0])
    def test_a_logger_whose_rate_is_no_multiple_of_the_policys(self, rate):
        """A policy of 50 Hz; actions that return, of a bang-bang policy, are no repetitions."""
        noise = torch.randn(200, 2, generator=torch.Generator().manual_seed(0))
        places = (torch.arange(int(4 * rate)) * (50.0 / rate) + 1e-6).long()
        with pytest.warns(UserWarning, match=f"every action {rate / 50:.3g} times"):
            found = diagnose_actions(noise[places], rate=rate)
        assert torch.equal(found.actions, noise) and found.rate == pytest.approx(50.0, rel=1e-2)
        held = noise.sign()[places]
        assert torch.equal(diagnose_actions(held).actions, held)

    def test_lost_commands_are_no_repetitions(self):
        """Half of the rows are those before: time would be stretched by what is left out."""
        drawn = torch.Generator().manual_seed(0)
        noise = torch.randn(2000, 1, generator=drawn)
        kept = torch.rand(2000, generator=drawn) > 0.45
        kept[0] = True
        actions = noise[torch.where(kept, torch.arange(2000), 0).cummax(0).values]
        found = diagnose_actions(actions, rate=50.0)
        assert torch.equal(found.actions, actions) and found.rate == 50.0

    def test_held_and_rounded_actions_are_no_repetitions(self):
        """A rest between movements, and a slow movement in few levels."""
        rest = torch.cat([0.5 * SINE, torch.zeros(500, 1)])
        levels = (torch.sin(2 * torch.pi * torch.arange(2000) / 500) * 4).round().unsqueeze(1)
        for actions in (rest, levels, torch.zeros(50, 1)):
            assert torch.equal(diagnose_actions(actions).actions, actions)

    @pytest.mark.parametrize("separator", [",", ";", "\t"])
    def test_a_file_has_names_and_seconds(self, tmp_path, separator):
        """Anywhere among the columns; Windows' marks and ends of lines do not matter."""
        rows = [["# hip", " time ", "knee"]]
        rows += [[f"{(-1) ** i}", f"{i / 50}", "0"] for i in range(20)]
        path = tmp_path / "robot.csv"
        lines = "\r\n".join(separator.join(row) for row in [*rows, []])
        path.write_bytes(f"\ufeff{lines}".encode())
        found = diagnose_recording(path)
        assert found.actions.shape == (20, 2) and found.actions[1].tolist() == [-1.0, 0.0]
        assert found.rate == pytest.approx(50.0) and found.name == str(path)
        (only,) = findings(found)
        assert only.text.startswith("hip flips from step to step, which is shaking at 25 Hz")

    def test_columns_are_chosen_among_others(self, tmp_path):
        """The others may hold anything."""
        rows = [f"{i},walk,{(-1) ** i}" for i in range(20)]
        path = table_file(tmp_path / "a.csv", "step,mode,knee", *rows)
        assert diagnose_recording(path, columns=["knee"]).actions.shape == (20, 1)
        with pytest.raises(UserError, match="no column 'hip': choose from step, mode, knee"):
            diagnose_recording(path, columns=["hip"])
        with pytest.raises(UserError, match="the column 'knee' was chosen twice: name it once"):
            diagnose_recording(path, columns=["knee", "knee"])
        with pytest.raises(UserError, match=r"line 2: 'mode' must be a finite number, got 'walk'"):
            diagnose_recording(path)

    def test_a_counter_of_steps_is_no_time(self, tmp_path):
        path = table_file(tmp_path / "a.csv", "time,a", *(f"{i},{(-1) ** i}" for i in range(20)))
        with pytest.warns(UserWarning, match="has steps of 1 s: if it counts the steps, multiply"):
            diagnose_recording(path)

    @pytest.mark.parametrize(("rate", "decimals"), [(400, 3), (300, 3), (60, 2), (30, 2), (15, 2)])
    def test_times_may_be_rounded(self, tmp_path, rate, decimals):
        """The median step is one of two lengths; a lost row now and then does not count."""
        times = [i / rate for i in range(1000) if i % 100 != 50]
        rows = [f"{t:.{decimals}f},{(-1) ** i}" for i, t in enumerate(times)]
        path = table_file(tmp_path / "a.csv", "time,a", *rows)
        assert diagnose_recording(path).rate == pytest.approx(rate, rel=0.01)

    def test_gaps_are_told(self, tmp_path):
        """The rate is that of the other steps."""
        times = [i / 10 + (0.5 if i > 3 else 0.0) for i in range(20)]
        rows = [f"{t},{(-1) ** i}" for i, t in enumerate(times)]
        path = table_file(tmp_path / "a.csv", "time,a", *rows)
        told = r"has gaps \(1, the first before line 6, the longest of 0.6 s\)"
        with pytest.warns(UserWarning, match=told):
            assert diagnose_recording(path).rate == pytest.approx(10.0)

    @pytest.mark.parametrize(
        ("lines", "message"),
        [
            ([], r"line 1: expected the names of the columns, got \['?'?\]"),
            (["0.1,0.2", "0.3,0.4"], r"line 1: expected the names .*'0.1'"),
            ([",a", "0,1"], r"line 1: column 1 has no name.*index=False"),
            (["a,a", "0,1"], r"line 1: several columns are named 'a'"),
            (["a,b", "0,1", "0"], r"line 3: expected 2 cells as in the first line, got 1"),
            (["a", "0", "x"], r"line 3: 'a' must be a finite number, got 'x'"),
            (["a", "0", "nan"], r"line 3: 'a' must be a finite number, got 'nan': leave"),
            (["a;b", "0,5;1"], r"line 2: 'a' .*, got '0,5': write a decimal point instead"),
            (["a b", "0.5 1"], r"got '0.5 1': separate the columns by commas, semicolons or tabs"),
            (["a", "0", "1", "0"], r"at least 20 steps and one action, got \[3, 1\]"),
            (["time", *map(str, range(20))], r"at least 20 steps and one action, got \[20, 0\]"),
            (["a,time", "0,0", "0,1", "0,1", "0,2"], r"line 4: the column 'time' must increase"),
            (["a,step", *(f"{i % 2},{i}" for i in range(20))], "'step' increases in every row"),
            (
                ["a,time", *(f"{i % 2},{i}e7" for i in range(20))],
                "steps of 1e.07: divide it, by 1e3 if",
            ),
        ],
    )
    def test_what_is_no_table_of_actions_is_refused(self, tmp_path, lines, message):
        """With the line."""
        with pytest.raises(UserError, match=message):
            diagnose_recording(table_file(tmp_path / "a.csv", *lines))

    @pytest.mark.parametrize(
        ("settings", "message"),
        [
            ({"bounds": (1.0, -1.0)}, "bounds must be two finite numbers, the lower one first"),
            ({"bounds": (0.0, float("inf"))}, "bounds must be two finite numbers"),
            ({"bounds": (-0.5, 0.5)}, r"lies beyond the bounds -0.5 and 0.5, as 1: give bounds in"),
            ({"rate": 0.0}, "rate must be a number of steps per second above 0"),
            ({"action_names": ["a", "b"]}, "a name for each of the 1 actions, got 2 names"),
        ],
    )
    def test_wrong_settings_are_refused(self, settings, message):
        """Before anything is measured."""
        with pytest.raises(UserError, match=message):
            diagnose_actions(SINE, **settings)
        broken = SINE.clone()
        broken[7] = float("nan")
        with pytest.raises(UserError, match=r"must be finite, got \[nan\] in row 7"):
            diagnose_actions(broken)

    def test_a_slow_action_does_not_change_by_nothing(self):
        """A ramp over a fiftieth of the range."""
        ramp = torch.linspace(0.0, 0.04, len(SINE)).unsqueeze(-1)
        (only,) = findings(diagnose_actions(ramp, bounds=(-1.0, 1.0)))
        assert "changes by less than 0.1% of its range per step" in only.text

    def test_every_action_may_have_its_own_bounds(self):
        """A knee that is at its narrow bounds, and a hip that uses half of its wide ones."""
        jumps = 0.5 * SINE.sign()
        found = diagnose_actions(
            torch.cat((SINE, jumps), 1), action_names=["hip", "knee"], bounds=[(-2, 2), (-0.5, 0.5)]
        )
        assert (found.low.tolist(), found.high.tolist()) == ([-2.0, -0.5], [2.0, 0.5])
        (finding,) = (each.text for each in findings(found) if "bang-bang" in each.text)
        assert finding.startswith("knee is bang-bang")
        one = diagnose_actions(torch.cat((SINE, jumps), 1), bounds=[(-2, 2)])  # of both
        assert one.low.tolist() == [-2.0, -2.0]
        with pytest.raises(UserError, match="a pair for each of the 1, got 2 pairs"):
            diagnose_actions(SINE, bounds=[(-1, 1), (-1, 1)])

    def test_bounds_must_be_apart(self):
        with pytest.raises(UserError, match="the lower one first"):
            diagnose_actions(SINE, bounds=(1.0, 1.0))

    def test_what_does_not_compare_is_not_compared(self):
        """Other actions, or another rate."""
        hip = diagnose_actions(SINE, name="a", action_names=["hip"], rate=50.0)
        for other, why in (
            (diagnose_actions(SINE, name="b", action_names=["knee"]), "actions have other names"),
            (diagnose_actions(SINE, name="b", rate=60.0), "steps have 60 and 50 Hz"),
            (diagnose_actions(SINE.repeat(1, 2), name="b"), "they have 2 and 1 actions"),
        ):
            (sentence,) = comparison([hip, other])
            assert sentence.startswith("b and a do not compare: ") and why in sentence

    def test_it_stands_beside_a_policy(self):
        """Without what needs the policy; the comparison leaves the return out."""
        recorded = diagnose_actions(0.5 * FLIPPING, name="robot", action_names=["<knee>"])
        played = made_up(name="policy")
        assert comparison([played, recorded]) == [
            "robot changes its action 50 times as much from step to step as policy (1, 0.0199)."
        ]
        text = page([played, recorded])
        for name, pictures in (("policy", 4), ("robot", 2)):
            assert text.count(f"<figcaption>{name}</figcaption>") == pictures
        assert "<td>1 (&lt;knee&gt;, step 1)</td>" in text
        assert "nan" not in text and "&lt;knee&gt; flips" in text and "<knee>" not in text
        alone = page([recorded])
        for heading in (
            "Test episodes",
            "Where policy",
            "Neighbors",
            "stand still",
            "change by noise (",
        ):
            assert heading in text and heading not in alone


class TestPage:
    """Needs nothing else."""

    def test_it_has_no_reference_to_anything_outside(self, tmp_path):
        """No address, no script, no source but what is inside it."""
        one = made_up(name="a <b>")
        text = write_page(tmp_path / "page.html", [one]).read_text()
        assert write_page(tmp_path / "one.html", one).read_text() == text
        assert "://" not in text and "<script" not in text and "url(" not in text
        assert "<link" not in text and "@import" not in text and "href" not in text
        sources = re.findall(r"src=.(.{11})", text)
        assert len(sources) == 4 and set(sources) == {"data:image/"}
        assert "width=device-width" in text and "a &lt;b&gt;" in text and "a <b>" not in text

    def test_several_stand_side_by_side(self):
        """Each has its words, a column of the table and every picture."""
        flipping = made_up(0.5 * FLIPPING, name="other", shares={"caps": TermShare(True, 0.1)})
        text = page([made_up(name="first"), flipping])
        assert text.count('<div class="card">') == 2
        # A step of the sine is 4 * .5 / 100 in the mean, of the other one 1.
        assert re.findall(r"width:([\d.]+)%", text) == ["2.0", "100.0"]
        assert "<th></th><th>first</th><th>other</th>" in text
        for name, pictures in (("first", 4), ("other", 5)):
            assert text.count(f"<figcaption>{name}</figcaption>") == pictures
        assert "flips from step to step" in text and "It is smooth" in text
        assert "angle" in text  # which never moves

    def test_none_is_refused(self, tmp_path):
        """There is nothing to show."""
        with pytest.raises(ValueError, match="at least one"):
            write_page(tmp_path / "page.html", [])

    def test_the_video_has_them_beside_one_another(self, tmp_path):
        """As long as the longest, at no more than 30 pictures a second, at the true speed."""
        ffmpeg = pytest.importorskip("imageio_ffmpeg")
        shots = [np.full((60, 64, 3), shade, np.uint8) for shade in range(101)]
        both = [made_up(pictures=shots, rate=60.0), made_up(pictures=shots[:41], rate=60.0)]
        (tmp_path / "film.mp4").write_bytes(film(both))
        frames, seconds = ffmpeg.count_frames_and_secs(str(tmp_path / "film.mp4"))
        assert frames == 51 and seconds == pytest.approx(51 / 30, abs=0.05)
        assert next(ffmpeg.read_frames(tmp_path / "film.mp4"))["size"] == (640, 400)


class Blank(Walk):
    """Draws nothing."""


gymnasium.register("Blank-v0", Blank)


class TestCommand:
    """Says it, and writes the page."""

    def test_two_runs(self, run, blank, tmp_path, capsys):
        """A video where the task draws pictures, a word where it does not."""
        pytest.importorskip("pygame")
        pytest.importorskip("imageio_ffmpeg")
        path = tmp_path / "new" / "page.html"
        main([str(run), str(blank), "--episodes", "1", "--output", str(path)])
        told, text = capsys.readouterr().out, path.read_text()
        assert text.count('src="data:video/mp4;base64,') == 1
        assert "Without pictures: " in text and "blank" in text
        assert f"page: {path}" in told and "  - " in told

    def test_the_page_lies_in_the_first_folder(self, run, capsys):
        """Without pictures if these are not wanted."""
        main([str(run), "--no-video", "--episodes", "1"])
        assert "<video" not in (run / "diagnosis.html").read_text()

    def test_recordings_stand_beside_runs(self, run, tmp_path, capsys):
        """The page lies next to the first of them."""
        robot = table_file(tmp_path / "robot.csv", "knee", *("1", "-1") * 10)
        chosen = ["--bounds", "-2", "2", "--no-video", "--episodes", "1"]
        picture = tmp_path / "actions.svg"
        main([str(robot), str(run), *chosen, "--actions", str(picture), "--names", "robot", "run"])
        told = capsys.readouterr().out
        assert told.startswith("robot: action variation 2\n  - knee flips from step to step")
        assert "\n\nrun: return " in told and f"page: {tmp_path / 'robot_diagnosis.html'}\n" in told
        assert "<!-- robot: action variation 2 -->" in picture.read_text()
        each = table_file(tmp_path / "legs.csv", "hip,knee", *("1,3", "0,-3") * 10)
        main([str(each), "--bounds", "-9", "9", "--bounds", "-3", "3"])
        told = capsys.readouterr().out
        assert "knee is bang-bang" in told and "19 times, nearly every step" in told
        assert "hip is bang-bang" not in told
        with pytest.raises(SystemExit):
            main([str(run), "--bounds", "-2", "2"])
        assert "--bounds and --columns are of recorded actions: no CSV" in capsys.readouterr().err
        with pytest.raises(SystemExit, match=r"^error: .*none.csv"):
            main([str(tmp_path / "none.csv")])

    def test_actions_of_all_runs_are_one_picture(self, run, blank, tmp_path, capsys):
        """A row for each, by the names that were given, on the same axes."""
        path = tmp_path / "new" / "actions.svg"
        names = ["the first", "the second"]
        chosen = ["--names", *names, "--actions", str(path), "--no-video", "--episodes", "1"]
        main([str(run), str(blank), *chosen])
        told, picture = capsys.readouterr().out, path.read_text()
        for name in names:
            assert f"{name}: return " in told and f"<!-- {name}: return " in picture
        assert "the second is of another task than the first (Blank-v0, Pendulum-v1)." in told
        rows = picture.split('<g id="axes_')[1:]
        ticks = [sorted(re.findall(r"<!-- ([^<>a-z]*\d) -->", row)) for row in rows]
        assert len(rows) == 2 and ticks[0] == ticks[1] != []

    def test_runs_are_called_as_in_tables(self, tmp_path):
        """By what they are, not by their folders; by these where their methods are alike."""

        def folder(name, **settings):
            path = tmp_path / name / "config.json"
            make_parent_folder(path)
            write_json(path, ExperimentConfig(**settings).to_dict())
            return str(tmp_path / name)

        tuned = L2C2Config(policy_distance="mean", lambda_min=10.0, lambda_max=1000.0)
        first = folder("0ddc7233/seed_0", regularizer=tuned)
        second = folder("none/seed_0", regularizer=NoRegularizerConfig())
        assert run_names([first, second]) == ["L2C2, means 10", "baseline"]
        third = folder("none/seed_1", regularizer=NoRegularizerConfig(), seed=1)
        assert run_names([first, third]) == ["L2C2, means 10/seed_0", "baseline/seed_1"]
        other = folder("sigma-2/seed_0", regularizer=replace(tuned, sigma=2.0))
        assert run_names([first, other]) == ["0ddc7233/seed_0", "sigma-2/seed_0"]

    def test_baselines_come_first_also_behind_links(self, run, tmp_path):
        """By their settings: the folder's name says nothing, and one config is damaged."""
        chosen = {"c": NoRegularizerConfig(), "a": NoRegularizerConfig(), "b": L2C2Config()}
        for name, regularizer in chosen.items():
            path = tmp_path / "elsewhere" / name / "config.json"
            make_parent_folder(path)
            write_json(path, ExperimentConfig(regularizer=regularizer).to_dict())
        (tmp_path / "elsewhere" / "none").mkdir()
        (tmp_path / "elsewhere" / "none" / "config.json").touch()
        above = tmp_path / "above"
        above.mkdir()
        (above / "link").symlink_to(tmp_path / "elsewhere")
        sorted_below = [str(above / "link" / name) for name in ("a", "c", "b", "none")]
        assert run_folders([str(above), str(run)]) == [*sorted_below, str(run)]

    def test_ctrl_c_is_one_line(self, run, monkeypatch, capsys):
        """Of every command that tells its errors so."""

        def stopped(*_, **__):
            raise KeyboardInterrupt

        monkeypatch.setattr("torchrl_l2c2.experiment.analysis.diagnosis.diagnose_run", stopped)
        with pytest.raises(SystemExit) as ended:
            main([str(run)])
        assert ended.value.code == 130 and capsys.readouterr().err == "interrupted.\n"

    def test_no_file_of_a_run_is_overwritten(self, run, tmp_path):
        """Nor a recording: the page ends in .html, a picture in .svg, a test in .json."""
        before = {path: path.read_bytes() for path in run.iterdir() if path.is_file()}
        for wrong, message in (
            (["--output", str(run / "policy.pt")], r"ends in \.html, got '.*policy.pt'"),
            (["--actions", str(tmp_path / "a.png")], r"ends in \.svg, got '.*a.png'"),
        ):
            with pytest.raises(SystemExit, match=message):
                main([str(run), *wrong])
        for name in ("evaluation.json", "config.json"):
            with pytest.raises(SystemExit, match=f"{name}' is a file of the run there"):
                evaluate.main([str(run), "--episodes", "1", "--output", str(run / name)])
        with pytest.raises(SystemExit, match=r"ends in \.json, got '.*metrics.csv'"):
            evaluate.main([str(run), "--output", str(run / "metrics.csv")])
        assert before == {path: path.read_bytes() for path in before}

    def test_what_is_wrong_is_one_line(self, run, tmp_path, capsys):
        """A folder that is no run; the same run twice; names that are too few."""
        with pytest.raises(SystemExit):
            main([str(run), str(tmp_path), "--names", "one"])
        assert "--names must have 2 names, one per run" in capsys.readouterr().err
        with pytest.raises(SystemExit):
            main([str(run), str(tmp_path), "--names", "a", "a"])
        assert "--names must differ from each other" in capsys.readouterr().err
        with pytest.raises(SystemExit, match=r"^error: '.*' is not a run folder"):
            main([str(tmp_path)])
        for name in ("a", "b"):
            make_parent_folder(tmp_path / "above" / name / "config.json")
            (tmp_path / "above" / name / "config.json").touch()
        with pytest.raises(SystemExit):
            main([str(tmp_path / "above"), "--names", "one"])
        assert "--names must have 2 names, one per run" in capsys.readouterr().err
        with pytest.raises(SystemExit, match=r"^error: Expected each run once"):
            main([str(run), str(run)])


def test_a_policy_that_is_no_actor_is_refused():
    """Before anything is played."""
    with pytest.raises(TypeError, match=r"policy must be an actor of TorchRL, got None"):
        diagnose(None, GymEnv("Pendulum-v1"))
    loss = BCLoss(Actor(torch.nn.Linear(3, 1)))
    with pytest.raises(TypeError, match="got BCLoss, a loss: give the actor"):
        diagnose(loss, GymEnv("Pendulum-v1"))
