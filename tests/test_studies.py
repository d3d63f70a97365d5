"""The lab's tables by hand, and every generated part of its pages as its records have it."""

from __future__ import annotations

import json
import math
import re
import statistics
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from itertools import combinations

import numpy as np
import pandas as pd
import pytest
from scipy.stats import fisher_exact

from studies import forest, half_cheetah, pages, strength, td3, trace
from studies.cells import improvements_over_tasks, over_tasks
from studies.field import BETTER, field_groups, field_table
from studies.files import ROOT, fill
from studies.methods import against_table, choice_table, pairwise_tables
from studies.pages import OURS, is_drawn, one_setting
from studies.paper import (
    deployed_table,
    faster_targets_table,
    is_as_usual,
    paper_of,
    paper_table,
    shown_groups,
)
from studies.protocol import main as score
from studies.protocol import until, variants
from studies.summary import benchmarks, with_cats
from studies.targets import gain_targets_table
from tests.test_reports import METHODS, cells, make_config, make_run, table_of
from torchrl_l2c2.experiment import (
    CATSConfig,
    Experiment,
    ExperimentConfig,
    L2C2Config,
    NoRegularizerConfig,
    PPOConfig,
    PPORPEConfig,
    SACConfig,
    TaskConfig,
)
from torchrl_l2c2.experiment.analysis.reports import (
    group_records,
    read_records,
    read_runs,
    records_of,
)
from torchrl_l2c2.experiment.analysis.reports.records import merge
from torchrl_l2c2.experiment.analysis.reports.statistics import probability_of_improvement
from torchrl_l2c2.experiment.analysis.reports.table import COMPARED, Estimate, improvement
from torchrl_l2c2.experiment.settings.optimizers import AdamConfig
from torchrl_l2c2.experiment.settings.regularizers import REGULARIZERS
from torchrl_l2c2.experiment.settings.tasks import TASKS
from torchrl_l2c2.presets import preset


def read(folder):
    return [run.record for run in read_runs(folder)]


def change_summary(folder, **values):
    path = folder / "evaluation.json"
    content = json.loads(path.read_text())
    content["summary"] |= values
    path.write_text(json.dumps(content))


class TestPaper:
    def test_its_probabilities_are_of_all_pairs_with_the_baseline(self, tmp_path):
        """Of returns 15 and 25 beside 10 and 20 three of four are larger; a tie is a half."""
        runs = {"none": ((10.0, 0.1), (20.0, 0.1)), "l2c2": ((15.0, 0.1), (25.0, 0.05))}
        for method, results in runs.items():
            for seed, result in enumerate(results):
                config = make_config(regularizer=method, seed=seed)
                make_run(tmp_path / method / str(seed), config, *result)
        make_run(tmp_path / "sac", make_config(algorithm=SACConfig()), 99.0, 0.1)
        table = paper_table(shown_groups(table_of(read(tmp_path))))
        assert [row[:2] for row in table.rows] == [["swingup", "baseline"], ["swingup", "L2C2"]]
        row = dict(zip(table.columns, table.rows[1], strict=True))
        assert row["P(returns more)"].split()[0] == "0.75"
        assert row["P(smoother)"].split()[0] == "0.75"
        assert table.rows[1][3:6] == ["20.00 (7.07)†", "693.8 (123.8)", "50.00 (7.07)"]
        assert table.rows[0][6] == table.rows[0][-2] == ""
        assert (table.columns[-1], table.rows[0][-1]) == ("policy scale", "0.500 (0.000)")

    @pytest.mark.parametrize(("total", "marks"), [(693.0 + 123.0, 0), (693.0 - 126.0, 1)])
    def test_a_cell_beyond_the_papers_deviation_is_marked(self, tmp_path, total, marks):
        """The paper's L2C2 on Swingup: 693.77 (123.78) at .075 (.012); .08 lies within."""
        make_run(tmp_path / "run", make_config(regularizer="l2c2"), total, 0.08)
        (row,) = paper_table(group_records(table_of(read(tmp_path)))).rows
        assert "".join(row).count("†") == marks

    def test_as_deployed_they_are_compared_by_their_mean_actions(self, tmp_path):
        """Other numbers than those of sampled actions, and other probabilities."""
        make_run(tmp_path / "run", make_config(), 10.0, 0.1)
        (record,) = read(tmp_path)
        figures = ("late_mean_return", "late_mean_action_variation")
        records = [
            replace(record, method=method, seed=seed, **dict(zip(figures, values, strict=True)))
            for method, runs in {
                "none": ((10.0, 0.5), (20.0, 0.5)),
                "l2c2": ((15.0, 0.4), (25.0, 0.6)),
            }.items()
            for seed, values in enumerate(runs)
        ]
        plain, smooth = deployed_table(group_records(table_of(records))).rows
        assert plain[3:] == ["15.00 (7.07)", plain[4], "", "0.500 (0.000)", plain[7], ""]
        assert (smooth[3], smooth[6]) == ("20.00 (7.07)", "0.500 (0.141)")
        assert (smooth[5].split()[0], smooth[8].split()[0]) == ("0.75", "0.50")

    def test_the_last_rows_are_the_means_over_tasks(self, tmp_path):
        """Of 1 on Swingup, and of a half on Reacher, where returns are the baseline's own."""
        for task, ahead in (("swingup", 5.0), ("reacher", 0.0)):
            for method, total in (("none", 10.0), ("caps", 10.0 + ahead)):
                for seed in (0, 1):
                    config = make_config(task=task, regularizer=method, seed=seed)
                    folder = tmp_path / task / method / str(seed)
                    make_run(folder, config, total, 0.1 - total / 1000)
        groups = group_records(table_of(read(tmp_path)))
        for make, returned in ((paper_table, 6), (deployed_table, 5)):
            row = make(groups).rows[-1]
            assert row[:3] == ["2 tasks", "CAPS", ""] and row[returned].startswith("0.75 [")
            assert sum(bool(cell) for cell in row) == 4

    def test_faster_targets_are_beside_the_papers_returns(self, tmp_path):
        """376 and 284 at tau .5, Table III's at .1; other methods and other paces have none."""
        for tau in (0.1, 0.5, 0.3):
            for method, total in (("l2c2", 300.0), ("l2c2_policy", 200.0), ("caps", 100.0)):
                for seed in range(2):
                    settings = {"algorithm": PPORPEConfig(tau=tau), "seed": seed, "episodes": 350}
                    config = make_config(regularizer=method, **settings)
                    folder = tmp_path / f"{tau}" / method / str(seed)
                    make_run(folder, config, total + 10 * seed - 100 * tau, 0.1)
        records = read(tmp_path)
        of_rows = {
            row[1]: (row[3].split()[0], *row[5:])
            for row in faster_targets_table(table_of(records)).rows
        }
        assert of_rows == {
            "L2C2": ("295.0", "693.8", "1.00 [1.00, 1.00]"),
            "L2C2, beta=0": ("195.0", "707.4", ""),
            "L2C2, tau=0.3": ("275.0", "", "1.00 [1.00, 1.00]"),
            "L2C2, beta=0, tau=0.3": ("175.0", "", ""),
            "L2C2, tau=0.5": ("255.0", "376.0", "1.00 [1.00, 1.00]"),
            "L2C2, beta=0, tau=0.5": ("155.0", "284.0", ""),
        }
        # And Table III is not of them.
        published = {row[1]: row[4] for row in paper_table(group_records(table_of(records))).rows}
        assert published["L2C2"] == "693.8 (123.8)" and published["L2C2, tau=0.5"] == ""

    def test_its_numbers_are_those_of_its_own_task_and_algorithm(self, tmp_path):
        """Not of SAC, another task under its name, or L2C2 with another gain."""
        other = replace(TASKS["swingup"], name="other", env_id="Pendulum-v1", episodes=20)
        for name, config in {
            "paper": make_config(),
            "sac": make_config(algorithm=SACConfig(), seed=1),
            "other": replace(make_config(seed=2), task=other),
            "gain": make_config(regularizer=L2C2Config(beta=0.5)),
        }.items():
            make_run(tmp_path / name, config, 1.0, 0.1)
        found = {
            run.folder.name: paper_of(*group_records(records_of([run])))
            for run in read_runs(tmp_path)
        }
        assert found["paper"].return_mean == 649.57
        assert all(found[name] is None for name in ("sac", "other", "gain"))

    def test_runs_of_the_default_length_stand_for_their_task(self, tmp_path):
        """Where it has some; else the others do."""
        make_run(tmp_path / "run", make_config(), 1.0, 0.1)
        (short,) = read(tmp_path)
        usual = replace(short, length=f"{TASKS['swingup'].episodes} episodes", seed=7)
        groups = {group.seeds[0]: group for group in group_records(table_of([short, usual]))}
        assert is_as_usual(groups[7]) and not is_as_usual(groups[0])
        assert [group.seeds for group in shown_groups(table_of([short]))] == [[0]]
        assert [group.seeds for group in shown_groups(table_of([short, usual]))] == [[7]]


@pytest.fixture
def pendulum(tmp_path):
    """Records of three methods on Pendulum: return, action variation and Sm of seeds 0 and 1."""
    for method, seeds in {
        "none": ((10.0, 0.1, 0.4), (20.0, 0.2, 0.1)),
        "l2c2": ((15.0, 0.1, 0.2), (25.0, 0.2, 0.2)),
        "cats": ((25.0, 0.3, 0.3), (25.0, 0.3, 0.3)),
    }.items():
        for seed, (total, varied, sm) in enumerate(seeds):
            chosen = CATSConfig() if method == "cats" else method
            settings = {"algorithm": PPOConfig(), "regularizer": chosen, "seed": seed}
            folder = tmp_path / method / str(seed)
            make_run(folder, make_config(task="pendulum", **settings), 0.0, varied)
            figures = {"return_mean": total, "action_variation_mean": varied, "sm_asap_mean": sm}
            change_summary(folder, **figures)
    other = make_config(task="pendulum", algorithm=PPOConfig(gamma=0.5), regularizer="none")
    make_run(tmp_path / "other", other, 99.0, 0.0)
    return read(tmp_path)


@pytest.fixture(scope="module")
def forty(tmp_path_factory):
    """Records of two tasks, four methods and five seeds: returns are ``100 m + seed``."""
    folder = tmp_path_factory.mktemp("forty")
    for task in ("swingup", "reacher"):
        for m, (name, method) in enumerate(METHODS.items()):
            for seed in range(5):
                config = make_config(task=task, regularizer=method, seed=seed)
                make_run(folder / task / name / str(seed), config, 100.0 * m + seed, 0.1 - 0.01 * m)
    return read(folder)


class TestOverTasks:
    def test_runs_are_counted_by_task(self, forty):
        """None of 20 pairs and all of 15, of seeds that the tasks do not share."""
        caps = [r for r in forty if r.method == "caps"]
        swingup, reacher = ([r for r in caps if r.task == t] for t in ("swingup", "reacher"))
        # Four runs that return less than every run of the baseline, and one without a test.
        lost = [replace(r, last_mean_return=-9.0) for r in swingup[1:]]
        untested = replace(swingup[0], last_mean_return=math.nan)
        others = [replace(r, seed=100 + r.seed) for r in reacher[:3]]
        baseline = [r for r in forty if r.method == "none"]
        groups = group_records(table_of([untested, *lost, *others, *baseline]))
        ((*_, cells),) = improvements_over_tasks(groups, "last_mean", ["return"])
        assert cells == ["0.50 [0.50, 0.50]"]
        groups = group_records(table_of([untested, *others, *baseline]))
        assert not improvements_over_tasks(groups, "last_mean", ["return"])

    def test_other_settings_of_a_method_are_another_row(self, forty):
        """Also if every task has only one of them, so the names are the same."""
        chosen = [r for r in forty if r.method == "none"]
        for task, changed in (("swingup", False), ("reacher", True)):
            ours = [r for r in forty if (r.task, r.method) == (task, "l2c2")]
            chosen += [r for r in ours if ("regularizer.beta" in r.differences) == changed]
        groups = group_records(table_of(chosen))
        assert [group.name for group in groups] == ["baseline", "L2C2"] * 2
        rows = over_tasks(group for group in groups if group.first.method != "none")
        assert [(name, [g.first.task for g in row]) for _, name, row in rows] == [
            ("L2C2", ["swingup"]),
            ("L2C2", ["reacher"]),
        ]


class TestField:
    def test_published_rows_are_beside_the_means_over_seeds(self, tmp_path):
        """Of those tasks with PPO and SAC alone; an interval and P from two runs on."""
        chosen = {"task": "hopper_v5", "algorithm": PPOConfig()}
        for method, seeds in (("none", 1), ("caps", 2), ("l2c2_ramp", 1)):
            for seed in range(seeds):
                folder = tmp_path / method / str(seed)
                make_run(folder, make_config(regularizer=method, seed=seed, **chosen), 100.0, 0.1)
                change_summary(folder, sm_asap_mean=0.4 + 0.2 * seed)
        make_run(tmp_path / "paper", make_config(), 10.0, 0.1)
        table = field_table(table_of(read(tmp_path)))
        assert cells(table, "hopper_v5", "ppo", "CAPS") == [
            "0, 1",
            "120.0 [120.0, 120.0]",
            "0.120 [0.120, 0.120]",
            "0.500 [0.400, 0.600]",
            *("", ""),  # The baseline has a single run, which says nothing of how runs vary.
            "2440",
            "0.471",
        ]
        alone = ["0", "120.0", "0.120", "0.400", "", "", "", ""]
        assert cells(table, "hopper_v5", "ppo", "L2C2, means, ramp") == alone
        assert cells(table, "hopper_v5", "ppo", "LipsNet++") == [*[""] * 6, "1878", "0.543"]
        assert len(table.rows) == 8  # CAPS and vanilla once, as they were run
        assert {row[0] for row in table.rows} == {"hopper_v5"}
        # With noise, or shorter episodes, it is another task.
        other = [replace(r, differences="task.max_steps=60") for r in read(tmp_path)]
        assert all(row[-2:] == ["", ""] for row in field_table(table_of(other)).rows if row[3])

    def test_a_mean_says_of_how_many_runs_it_is(self, pendulum):
        """Those that were cut to a length have no last policy."""
        lacking = [replace(r, last_mean_return=math.nan) if r.seed else r for r in pendulum]
        row = cells(field_table(table_of(lacking)), "pendulum", "ppo", "CATS")
        assert row[1] == "25.00, of 1 runs" and row[2] == "0.300 [0.300, 0.300]"

    def test_settings_are_in_order_over_tasks(self, tmp_path):
        """By hand: returns by 10 and by -25 of 100, Sm half and twice; another at .8 and .8."""
        shares = {s: L2C2Config(gain="target", gain_target=s) for s in (0.1, 0.3)}
        cases = {
            "pendulum": {"none": (-100.0, 0.4), 0.1: (-90.0, 0.2), 0.3: (-100.0, 0.32)},
            "lunarlander": {"none": (100.0, 0.4), 0.1: (75.0, 0.8), 0.3: (110.0, 0.32)},
        }
        for task, methods in cases.items():
            for method, (total, sm) in methods.items():
                # The baseline has a seed of its own, which does not count.
                for seed in range(3 if method == "none" else 2):
                    chosen = {"regularizer": shares.get(method, method), "seed": seed}
                    config = make_config(task=task, algorithm=PPOConfig(), **chosen)
                    folder = tmp_path / task / str(method) / str(seed)
                    make_run(folder, config, total, 0.1)
                    off = 10.0 * seed - 5.0 if seed < 2 else 1000.0
                    change_summary(folder, return_mean=total + off, sm_asap_mean=sm)
        records = read(tmp_path)
        table = choice_table(table_of(records))
        # Of all pairs of these seeds: returns of .1 win 3.5 of 4 and none, of .3 2 and 3.5 of 4.
        assert [[*row[:-2], *(cell.split()[0] for cell in row[-2:])] for row in table.rows] == [
            ["ppo", f"L2C2, gain_target={share}", "pendulum, lunarlander", "0, 1", *row]
            for share, row in {
                0.3: ["+5%", "+0% pendulum", "0.80", "0.80 pendulum", "0.69", "1.00"],
                0.1: ["-8%", "-25% lunarlander", "1.00", "2.00 lunarlander", "0.44", "0.50"],
            }.items()
        ]
        # .3 beside .1: a half of 4 pairs of Pendulum and all of LunarLander's; Sm of these alone.
        pairwise = pairwise_tables(table_of(records))
        assert [each.title.split(",")[0] for each in pairwise] == [*BETTER.values()]
        first, last = (f"L2C2, gain_target={share}" for share in (0.1, 0.3))
        for each, better in zip(pairwise, (0.56, 0.50), strict=True):
            assert [*each.columns] == ["method", "baseline", first, last]
            found = by_methods(each)
            assert found[last][first].split()[0] == f"{better:.2f}"
            assert found[first][last].split()[0] == f"{1 - better:.2f}"
            assert [found[name][name] for name in found] == ["", "", ""]

    def test_beside_nothing_there_are_no_parts(self, pendulum, recwarn):
        """A baseline that returned 0, or did not move: a dash."""
        still = [
            replace(r, last_mean_return=0.0, last_mean_sm_asap=0.0) if r.method == "none" else r
            for r in pendulum
        ]
        row = cells(choice_table(table_of(still)), "ppo", "CATS")
        assert row[2:6] == ["-", "- pendulum", "-", "- pendulum"] and not recwarn.list

    def test_runs_of_another_length_are_not_compared(self, pendulum):
        """Each against each: of CATS trained ten times as long nothing is left beside two."""
        longer = [
            replace(r, length="200 episodes", settings="x") if r.method == "cats" else r
            for r in pendulum
        ]
        usual = [r for r in pendulum if "gamma" not in r.differences]
        assert not pairwise_tables(table_of(longer)) and len(pairwise_tables(table_of(usual))) == 2

    def test_one_method_against_each_other_one(self, pendulum):
        """Of four pairs three return more, a half is smoother by Sm; a tie counts half."""
        table = against_table(table_of(pendulum), "L2C2")
        # The run with another discount is no row.
        assert [row[:4] for row in table.rows] == [
            ["pendulum", "ppo", name, "0, 1"] for name in ("baseline", "CATS")
        ]
        baseline, cats = ([cell.split()[0] for cell in row[4:]] for row in table.rows)
        assert baseline == [
            *("20.00", "15.00", "0.75", "0.150", "0.150", "0.50", "0.200", "0.250", "0.50")
        ]
        assert cats == [
            *("20.00", "25.00", "0.25", "0.150", "0.300", "1.00", "0.200", "0.300", "1.00")
        ]

    def test_seeds_without_a_measure_are_told(self, pendulum):
        """They are in no mean and in no pair."""
        lacking = [
            replace(r, last_mean_sm_asap=math.nan) if (r.method, r.seed) == ("l2c2", 1) else r
            for r in pendulum
            if "gamma" not in r.differences
        ]
        row = against_table(table_of(lacking), "L2C2").rows[0]
        assert row[4] == "20.00" and row[10].endswith(", of 1 runs")
        notes = [table.notes for table in pairwise_tables(table_of(lacking))]
        assert [len(each) for each in notes] == [1, 2]
        assert notes[1][1] == "Not all runs have it: pendulum, L2C2, of 1 runs."


def test_targets_have_what_came_of_them_and_what_they_cost(tmp_path):
    """Late policies with samples: .045 of .05 is a tenth less; the last one's mean is 20 more."""

    def asked(target, **settings):
        return L2C2Config(gain="target", gain_target=target, **settings)

    for name, regularizer, seed, varied in (
        ("one", asked(0.05), 0, 0.04),
        ("two", asked(0.05), 1, 0.05),
        ("low", asked(0.02), 0, 0.02),
        ("none", "none", 0, 0.1),
        ("constant", "l2c2", 0, 0.08),
    ):
        config = make_config(regularizer=regularizer, seed=seed)
        make_run(tmp_path / name, config, 100.0 * (seed + 1), varied)
    table = gain_targets_table(table_of(read(tmp_path)))
    assert table.columns[4:7] == ["target", "followed", "off by"]
    assert [row[2:7] for row in table.rows] == [
        ["L2C2, gain_target=0.02", "0", "0.020", "0.020", "+0%"],
        ["L2C2, gain_target=0.05", "0, 1", "0.050", "0.045 (0.007)", "-10%"],
        ["baseline", "0", "", "0.100", ""],
    ]
    assert [row[7:] for row in table.rows] == [
        ["100.0", "0.500", "0.040", "120.0"],
        ["150.0 (70.7)", "0.500 (0.000)", "0.065 (0.007)", "170.0 (70.7)"],
        ["100.0", "0.500", "0.120", "120.0"],
    ]


class TestProtocol:
    def test_the_score_is_the_protocols_by_hand(self, tmp_path):
        """Distances in the paper's deviations, at most 5, of the baseline and CAPS alone."""
        # The mean over seeds lies 77.96 above the paper's: one deviation. Smoother by 2 of .011.
        for seed, more in enumerate((67.96, 87.96)):
            make_run(tmp_path / f"none{seed}", make_config(seed=seed), 649.57 + more, 0.084 - 0.022)
        # 3 deviations of 26.56 below, and 100 of .002 too rough, which count as 5.
        make_run(tmp_path / "caps", make_config(regularizer="caps"), 239.57 - 79.68, 0.226)
        make_run(tmp_path / "l2c2", make_config(regularizer="l2c2"), -1e9, 9.0)
        records = read(tmp_path)
        (variant,) = variants(group_records(table_of(records)))
        assert variant.score("late_sampled") == pytest.approx((1 + 2 + 3 + 5) / 4)
        # With mean actions, returns are 12 higher and variations .012.
        distances = (1 + 12 / 77.96, 2 - 0.012 / 0.011, 3 - 12 / 26.56, 5)
        assert variant.score("late_mean") == pytest.approx(sum(distances) / 4, abs=1e-5)
        # Vanilla of other defaults, when it was run, is another reading.
        then = [replace(r, settings="then") for r in records if r.method == "none"]
        assert len(variants(group_records(table_of([*records, *then])))) == 2
        # Nor are CAPS's of other settings beside it.
        other = [replace(r, differences="algorithm.replay_ratio=5") for r in records]
        caps = [r for r in other if r.method == "caps"]
        assert not variants(group_records(table_of([*then, *caps])))

    def test_a_run_can_be_read_as_if_it_had_ended_earlier(self, tmp_path):
        """Its own episodes up to there; what only its end was tested for is unknown."""
        make_run(tmp_path / "run", make_config(), 1.0, 0.1)
        (run,) = read_runs(tmp_path)
        for row, total in zip(run.metrics, range(20), strict=True):
            row["return"] = str(total)
        record = until(run, 19).record
        # The last tenth of 19 episodes are two, the 18th and the 19th.
        assert (record.late_sampled_return, record.episodes, record.updates) == (17.5, 19, 190)
        assert (record.length, record.settings) == ("19 episodes", run.record.settings)
        assert math.isnan(record.late_mean_return) and math.isnan(record.last_sampled_return)
        assert until(run, 20) is run and until(run, 21) is None and until(run, 0) is None

    def test_late_policies_of_a_cut_training_are_its_own_share(self, tmp_path):
        """As of the uncut one, and not the last tenth whatever was asked for."""
        make_run(tmp_path / "0", make_config(late_share=0.2), 100.0, 0.1)
        (run,) = read_runs(tmp_path)
        # Two of five episodes are late: of returns of 100 and a million less.
        shorter, last = (until(run, length).record.late_sampled_return for length in (10, 19))
        assert shorter == -1e6
        assert last == pytest.approx((3 * -1e6 + 99.0) / 4)

    def test_a_run_of_frames_is_cut_by_them(self, tmp_path):
        """Its episodes are as long as they like, and the last one ends beyond what was asked."""
        config = make_config()
        make_run(tmp_path / "run", replace(config, task=replace(config.task, frames=2000)), 1, 0.1)
        (run,) = read_runs(tmp_path)
        cut = until(run, 1550).record
        assert (cut.length, cut.episodes) == ("1550 frames", 16)

    def test_lengths_are_rows_and_a_tested_run_stands_for_its_seed(self, tmp_path, capsys):
        """One that ended just then was tested, and comes before a longer one that was cut."""
        for episodes in (20, 10):
            for method in ("none", "caps"):
                config = make_config(episodes=episodes, regularizer=method)
                make_run(tmp_path / "runs" / method / str(episodes), config, float(episodes), 0.1)
        file = tmp_path / "records.csv"
        score([str(tmp_path / "runs"), "--length", "10", "15", "--csv", str(file)])
        rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines()]
        assert [(row[2], row[5]) for row in rows if len(row) == 11 and "defaults" in row[1]] == [
            ("10 episodes", "mean actions"),
            ("10 episodes", "sampled actions"),
            ("15 episodes", "sampled actions"),
        ]
        rows = read_records(file).itertuples()
        kept = {(r.method, r.length): r.last_mean_return for r in rows}
        assert kept["caps", "10 episodes"] == 30.0 and math.isnan(kept["caps", "15 episodes"])
        score([str(file)])
        assert "| swingup | the defaults | 15 episodes | 0 |" in capsys.readouterr().out
        for wrong, told in (
            ((str(file), "--length", "10"), "Expected folders of runs with --length"),
            ((str(tmp_path / "runs"), "--length", "30"), "Expected runs of 30 episodes"),
        ):
            with pytest.raises(SystemExit, match=f"error: {told}"):
                score(wrong)

    def test_what_goes_by_the_length_is_told_of_runs_that_were_cut(self, tmp_path, capsys):
        """They are not what a shorter training would have been; whole ones are."""
        ramped = make_config(regularizer="l2c2_ramp", optimizer=AdamConfig(linear=True))
        make_run(tmp_path / "run", ramped, 1.0, 0.1)
        score([str(tmp_path), "--length", "10"])
        printed = capsys.readouterr().out
        for setting in ("optimizer.linear=true", "regularizer.gain=ramp"):
            assert f"1 runs, cut to a length, have {setting} as in their own, longer" in printed
        score([str(tmp_path), "--length", "20"])
        assert "as in their own" not in capsys.readouterr().out


def by_methods(table):
    """The cells of a table of methods by methods."""
    return {row[0]: dict(zip(table.columns, row, strict=True)) for row in table.rows}


def records(name):
    return read_records(ROOT / "results" / f"{name}.csv")


@pytest.mark.slow
def test_one_command_writes_every_generated_part():
    """And changes nothing where all is as the records have it."""
    results = [path for path in (ROOT / "results").iterdir() if path.suffix in (".md", ".svg")]
    pages = [*results, ROOT / "README.md", ROOT / "docs" / "results.md"]
    before = [path.read_bytes() for path in pages]
    subprocess.run([sys.executable, "-m", "studies"], cwd=ROOT, check=True)
    assert [path.read_bytes() for path in pages] == before


class TestPages:
    def test_every_generated_part_is_that_of_its_records(self):
        """``python -m studies.pages`` would change nothing."""
        made = pages.pages()
        assert sum(len(page.parts) for page in made.values()) == 37
        for name, page in made.items():
            text = (ROOT / name).read_text()
            assert text.count(": start -->") == len(page.parts)
            for mark, part in page.parts.items():
                assert fill(text, mark, part) == text, (name, mark)
            assert page.draw is None or is_drawn((ROOT / name).with_suffix(".svg"), page.shown)

    def test_the_command_writes_what_is_not_as_it_should_be(self, tmp_path, monkeypatch, capsys):
        """Text around the marks stays; a picture of the same records does, too."""
        for module in ("files", "pages"):
            monkeypatch.setattr(f"studies.{module}.ROOT", tmp_path)
        page, picture = tmp_path / "page.md", tmp_path / "page.svg"
        page.write_text("before\n  <!-- a: start -->\n  old\n  <!-- a: end -->\nafter\n")
        shown = field_groups(records("sac_pendulum"))
        made = {"page.md": pages.Page({"a": "  new"}, shown, lambda path: path.write_text("drawn"))}
        monkeypatch.setattr(pages, "pages", lambda: made)
        pages.main()
        assert capsys.readouterr().out == "written: page.md\ndrawn: page.svg\n"
        assert page.read_text() == (
            "before\n  <!-- a: start -->\n  new\n  <!-- a: end -->\nafter\n"
        )
        drawn = pages.Path(__file__).parents[1] / "results" / "sac_pendulum.svg"
        picture.write_bytes(drawn.read_bytes())
        pages.main()
        assert capsys.readouterr().out == ""

    def test_a_text_without_the_marks_is_refused(self):
        """Rather than changed somewhere."""
        with pytest.raises(ValueError, match="once each"):
            fill("<!-- a: end -->\n<!-- a: start -->\n", "a", "results")


class TestProse:
    """Numbers within sentences, and tables that were written by hand."""

    def test_the_summary_by_hand(self):
        """A row of each table, recomputed from the records; the roughest baseline comes first."""
        runs = records("hopper").set_index("seed")
        sides = [runs[runs["method"] == method] for method in ("none", "l2c2_ramp")]
        named = {"action_variation": ".3f", "sm_asap": ".3f", "return": ".0f"}
        cells, totals, sm = [], [], []
        for measure, found in zip(named, (cells, sm, totals), strict=True):
            found += [format(side[f"last_mean_{measure}"].mean(), named[measure]) for side in sides]
        before, after = (side["last_mean_return"] for side in sides)
        lower = f"{(after < before).sum()} of 10"
        change = float(cells[1]) / float(cells[0]) - 1
        readme, page = ((ROOT / path).read_text() for path in ("README.md", "docs/results.md"))
        # In bold: the interval of the probability does not contain 0.5.
        row = ["Hopper", "PPO (10)", *cells, f"**{change:+.0%}**", *totals]
        assert f"| {' | '.join(row)} |" in readme
        (row,) = re.findall(r"^\| Hopper \| PPO \(10\) \| 0.*of 10 \|$", page, re.M)
        assert f"{' | '.join(cells)} |" in row and row.endswith(f"| {lower} |")
        assert f"| {' | '.join(totals)} |" in row
        assert f"| Hopper | PPO (10) | {' | '.join(sm)} |" in page
        rough = [
            side.scores("last_mean", "action_variation").mean() for _, side in benchmarks().values()
        ]
        assert rough == sorted(rough, reverse=True) and len(rough) == 20

    def test_what_the_other_time_limit_shows_on_hopper(self):
        """Six seeds of all methods, the means, and the order of L2C2 and the baseline."""
        runs = records("hopper_terminated")
        assert all(list(of["seed"]) == list(range(6)) for _, of in runs.groupby("method"))
        page = " ".join((ROOT / "results" / "paper.md").read_text().split())
        means = runs.groupby("method").mean(numeric_only=True)
        change, total = means["late_sampled_action_variation"], means["late_sampled_return"]
        text = f"than the baseline ({change['l2c2']:.3f} and {change['none']:.3f}) and returns less"
        assert f"{text} ({total['l2c2']:.0f} and {total['none']:.0f}), both beyond" in page
        runs = runs.set_index("method")
        late, last = (runs[f"{test}_sampled_return"] for test in ("late", "last"))
        assert late["l2c2"].max() < late["none"].min()
        assert last["l2c2"].max() > last["none"].min()

    def test_the_readmes_sentences(self):
        """The changes of rough and of smooth baselines, the losses of return, and untuned tasks."""
        readme = " ".join((ROOT / "README.md").read_text().split())
        rough, smooth, higher, beyond = [], [], [], Counter()
        for ours, baseline in benchmarks().values():
            for quantity in ("action_variation", "return"):
                better = improvement([ours], [baseline], "last_mean", quantity)
                beyond[quantity, better.interval[0] > 0.5, better.interval[1] < 0.5] += 1
            after, before = (
                group.scores("last_mean", "action_variation").mean() for group in (ours, baseline)
            )
            (rough if before > 0.08 else smooth).append(100 * (after / before - 1))
            total, other = (
                group.scores("last_mean", "return").mean() for group in (ours, baseline)
            )
            higher.append(total > other)
        assert len(smooth) == 5 and sum(higher) == 8 and len(higher) == 20
        assert f"In the {len(rough)} roughest of" in readme
        assert f"fell by {-max(rough):.0f} to {-min(rough):.1f}%, in thirteen of them" in readme
        assert f"the other five it changed by {min(smooth):.0f} to {max(smooth):+.0f}%" in readme
        # Fourteen with PPO on LunarLander, which is among the other five.
        assert beyond["action_variation", True, False] == 14
        assert beyond["action_variation", False, True] == 0
        assert (
            "was higher in eight and lower in twelve. Beyond seed noise, runs return more" in readme
        )
        assert "more in five benchmarks and less in one" in readme
        assert beyond["return", True, False] == 5 and beyond["return", False, True] == 1
        assert "nine of ten do with L2C2, and seven of ten baselines, within seed noise" in readme
        points, baseline = benchmarks()["noisy points", "PPO of rsl_rl"]
        returned = [group.scores("last_mean", "return").mean() for group in (points, baseline)]
        assert f"by {1 - returned[0] / returned[1]:.1%} on rsl_rl's noisy points" in readme
        assert td3.failures(benchmarks()["Pendulum", "TD3"][0]) == 2

    def test_swingup_again(self):
        """Returns of the six runs with newer code, next to the recorded ones."""
        page = " ".join((ROOT / "results" / "paper.md").read_text().split())
        (new,) = group_records(records("swingup_again"))
        (old,) = (group for group in group_records(records("runs")) if group.kind == new.kind)
        last, late, sampled = (
            [f"{group.scores(kind, 'return').mean():.0f}" for group in (new, old)]
            for kind in ("last_mean", "late_mean", "late_sampled")
        )
        assert "return {} with mean actions, and the recorded {}.".format(*last) in page
        assert "{} and {} with mean actions, {} and {} with sampled".format(*late, *sampled) in page
        better = improvement([new], [old], "last_mean", "return")
        assert f"with a probability of {better.text()}, beyond seed noise" in page
        assert better.interval[1] < 0.5

    def test_cats_on_the_benchmarks_that_have_it(self):
        """How many are smoother in the mean, and how probable a better run is."""
        pairs = with_cats()
        means = [[g.scores("last_mean", "action_variation").mean() for g in pair] for pair in pairs]
        smoother = sum(cats < ours for cats, ours in means)
        table = (ROOT / "docs" / "results.md").read_text().split("### CATS against L2C2")[1]
        assert f"{smoother} of {len(pairs)} |\n" in table
        for path in ("README.md", "docs/limitations.md", "docs/results.md"):
            assert f"over {len(pairs)} benchmarks" in " ".join((ROOT / path).read_text().split())
        sides = [list(side) for side in zip(*pairs, strict=True)]
        better = {q: improvement(*sides, "last_mean", q) for q in COMPARED}
        for estimate in better.values():
            assert estimate.text() in table
        # "Beyond seed noise, at the same return."
        assert better["return"].interval[0] < 0.5 < better["return"].interval[1]
        assert all(better[q].interval[0] > 0.5 for q in ("action_variation", "sm_asap"))

    def test_how_often_an_interval_excludes_chance(self):
        """Over all orders of two sides' runs that do not differ: one in five, and one in ten."""
        for seeds, share in ((3, 0.2), (5, 0.1)):
            excluded = []
            for places in combinations(range(2 * seeds), seeds):
                one = np.array(places, float)[:, None]
                other = np.setdiff1d(np.arange(2.0 * seeds), one)[:, None]
                low, high = Estimate.of(probability_of_improvement, one, other).interval
                excluded.append(low > 0.5 or high < 0.5)
            assert np.mean(excluded) == pytest.approx(share, abs=0.01)
        page = " ".join((ROOT / "docs" / "results.md").read_text().split())
        assert "one in five excludes 0.5 with three seeds, and one in ten with five" in page

    def test_rivals_over_four_tasks(self):
        """How probable a smoother run is, and one that returns more."""
        more, smoother = map(by_methods, pairwise_tables(one_setting()))
        weak = "CAPS, lambda_spatial=0.005"
        page = (ROOT / "results" / "one_setting.md").read_text()
        said = " ".join(page.partition("<!-- results: end -->")[2].split())
        start = said.partition(" * ")[0]
        for table in (more, smoother):
            assert table[OURS]["CATS"] in start and table[OURS]["CAPS"] in start
        assert smoother[OURS][weak] in said and more[weak][OURS] in said

    def test_both_lengths_of_sac(self):
        """Seed by seed, and in the mean."""
        page = (ROOT / "results" / "sac_pendulum.md").read_text()
        for frames, name in (("30,000", "sac_pendulum"), ("100,000", "sac_pendulum_100000")):
            rows = records(name).itertuples()
            runs = {r.seed: r for r in rows if r.method == "none" and r.seed < 5}
            pairs = [(runs[s].last_mean_return, runs[s].last_mean_sm_asap) for s in range(5)]
            row = [f"{total:.0f} / {sm:.3f}" for total, sm in pairs]
            mean = "{:.1f} / {:.3f}".format(*np.mean(pairs, 0))
            assert f"| {' | '.join([frames, *row, mean])} |" in page

    def test_sac_on_hopper(self):
        """The returns seed by seed, and the changes of the means."""
        page = (ROOT / "results" / "sac_hopper.md").read_text()
        runs = records("sac_hopper").set_index("method")
        start = " ".join(page.partition("<!-- results: start -->")[0].split())
        for method, name in (("none", "the baseline returns"), ("l2c2", "L2C2"), ("cats", "CATS")):
            *first, last = (f"{total:.0f}" for total in runs.loc[method, "last_mean_return"])
            assert f"{name} {', '.join(first)} and {last}" in start
        change = runs.groupby("method")[["last_mean_return", "last_mean_action_variation"]].mean()
        change = 100 * (change / change.loc["none"] - 1)
        totals, variations = (change[name].map("{:.0f}".format) for name in change)
        assert f"changes its actions {variations['l2c2'][1:]}% less" in start
        assert f"and CATS {variations['cats'][1:]}% less" in start
        assert f"returns {totals['l2c2'][1:]}% less than the baseline" in start
        assert f"and CATS {totals['cats']}% more" in start

    def test_sac_on_hopper_for_longer(self):
        """Every run of the seed that was also trained for longer has its row."""
        page = (ROOT / "results" / "sac_hopper.md").read_text().partition("## After 500,000")[2]
        runs = pd.concat([records("sac_hopper"), records("sac_hopper_500000")]).query("seed == 0")
        names = {"none": "baseline", "l2c2": "L2C2, means 10, ramp"}
        for run in runs[runs["method"].isin(names)].itertuples():
            tested = f"{run.last_mean_return:.0f} | {run.last_mean_action_variation:.3f}"
            frames = f"{int(run.length.split()[0]):,}"
            sm = f"{run.last_mean_sm_asap:.3f}"
            assert f"| {frames} | {names[run.method]} | {tested} | {sm} |" in page
        longer = records("sac_hopper_500000").set_index("method")
        less, more, sampled = (
            100 * abs(longer.loc["l2c2", column] / longer.loc["none", column] - 1)
            for column in ("last_mean_action_variation", "last_mean_return", "late_sampled_return")
        )
        text = " ".join(page.split())
        assert f"actions {less:.0f}% less than the baseline's, and returns {more:.0f}% more" in text
        assert f"with sampled actions, it returns {sampled:.0f}% less" in text

    def test_cats_as_strong_as_l2c2(self):
        """Both at the same strength, on two tasks: means, and how probable a better run is."""
        page = (ROOT / "results" / "one_setting.md").read_text().partition("## CATS, as strong")[2]
        groups = group_records(records("field"))
        for task, gain in (("pendulum", 0.5), ("lunarlander", 0.25)):
            named = {group.name: group for group in groups if group.first.task == task}
            ours, cats = named[OURS], named[f"CATS, lambda_temporal={gain}"]
            for group in (ours, cats):
                total, sm, variation = (
                    group.scores("last_mean", quantity).mean().item()
                    for quantity in ("return", "sm_asap", "action_variation")
                )
                row = f"0-9 | {total:.1f} | {sm:.3f} | {variation:.3f} |"
                assert f"| {task} | {group.name} | {row}" in page
            for quantity in ("return", "sm_asap"):
                better = improvement([ours], [cats], "last_mean", quantity).text("{:.2f}".format)
                assert better in page

    @pytest.mark.parametrize(
        "name", ["field", "walker2d", "hopper", "sac_pendulum", "sac_pendulum_100000"]
    )
    def test_the_harness(self, name):
        """The baseline's and the rivals' rows beside the published ones."""
        table = field_table(records(name))
        rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
        shown = [row for row in rows if row["seeds"] and not row["method"].startswith("L2C2")]
        columns = (*table.columns[:5], "published: return", "Sm", "published: Sm")
        page = (ROOT / "docs" / "field.md").read_text()
        gains = Counter((row["task"], row["method"].partition(",")[0]) for row in shown)
        for row in shown:
            method, _, gain = row["method"].partition(",")
            method += f",{gain}" if gain and gains[row["task"], method] > 1 else ""
            method += ", 100000 frames" if name.endswith("100000") else ""
            found = [row[column] for column in columns]
            assert f"| {' | '.join([*found[:2], method, *found[3:]])} |" in page

    def test_the_gains_of_sac(self):
        """Every run of the seeds that gains are chosen on is a cell; else the means are."""
        page = (ROOT / "results" / "field_gains.md").read_text()

        def cell(*runs):
            means = (
                statistics.fmean(getattr(r, f"last_mean_{name}") for r in runs)
                for name in ("return", "sm_asap")
            )
            return "{:.1f} / {:.3f}".format(*means)

        gains = records("sac_gains")
        assert all(cell(r) in page for r in gains.itertuples() if r.seed >= 100)
        shown = gains[(gains["seed"] < 100) & (gains["differences"].str.count("lambda_") > 1)]
        for group in group_records(merge(shown, records("sac_pendulum"))):
            assert cell(*group.runs.iloc[:4].itertuples()) in page, group.name

    def test_the_first_sentences_on_new_tasks(self):
        """The shares of the baseline's action variation, and the changes of the return."""
        page = " ".join((ROOT / "results" / "new_tasks.md").read_text().split())
        means = records("new_tasks").groupby(["task", "method"]).mean(numeric_only=True)
        ours, baseline = (means.xs(name, level="method") for name in ("l2c2", "none"))
        shares = (ours / baseline)["last_mean_action_variation"]
        smoother = shares[["Ant-v5", "BipedalWalker-v3", "HalfCheetah-v5"]]
        assert f"{100 * smoother.min():.0f} to {smoother.max():.0%} of the baseline's" in page
        assert 0.9 < shares["Reacher-v5"] < 1.1
        returns = {name: side["last_mean_return"] for name, side in (("l", ours), ("b", baseline))}
        gained = (returns["l"] - returns["b"]) / returns["b"].abs()
        assert set(gained[gained < -0.02].index) == {"HalfCheetah-v5"}
        assert set(gained[gained > 0.01].index) == {"Ant-v5", "BipedalWalker-v3", "Swimmer-v5"}
        lost = f"{-gained['HalfCheetah-v5']:.0%} lower"
        assert f"On HalfCheetah the mean return is {lost}, within seed noise" in page
        limits = (ROOT / "docs" / "limitations.md").read_text()
        assert f"[HalfCheetah](../results/new_tasks.md) it is {lost} within seed noise" in limits
        by_seed = records("new_tasks").pivot_table("last_mean_return", ["task", "seed"], "method")
        cheetah = by_seed.loc["HalfCheetah-v5"]
        lower = cheetah["l2c2"] < cheetah["none"]
        assert len(cheetah) == 10 and lower.sum() == 8
        first = cheetah.iloc[:5].mean()
        assert f"a loss of {1 - first['l2c2'] / first['none']:.0%} beyond seed noise" in page
        gait = pd.read_csv(ROOT / "results" / "half_cheetah.csv").set_index(["method", "seed"])
        assert set(gait.index) == set(cheetah.stack().index.swaplevel())
        on_back = gait["on_back"] > 0.5
        counts = on_back.groupby("method").sum()
        assert dict(counts) == {"l2c2": 9, "none": 7, "cats": 7}
        assert f"probability of {fisher_exact([[9, 1], [7, 3]]).pvalue:.2f}." in page
        totals = gait["return"]
        assert totals[on_back].max() < 0.75 * totals[~on_back].min()
        less = 1 - totals[on_back]["l2c2"].mean() / totals[on_back]["none"].mean()
        assert f"the mean return with L2C2 is {less:.0%} lower" in page
        ant = [returns[side]["Ant-v5"] for side in "bl"]
        assert f"return {ant[0]:.0f} on average, and with L2C2 {ant[1]:.0f}" in page
        swimmer = records("new_tasks").query("task == 'Swimmer-v5'").set_index(["method", "seed"])
        varied, total = swimmer["last_mean_action_variation"], swimmer["last_mean_return"]
        share = varied["l2c2"].mean() / varied["none"].mean()
        assert f"On Swimmer it is {share:.0%}, within seed noise" in page
        assert [(varied[method] < 0.05).sum() for method in ("none", "l2c2")] == [1, 1]
        assert total["l2c2"].mean() > total["none"].mean()

    def test_how_many_short_trainings_do_not_learn(self):
        """The counts of results/front_door.md: returns below -200."""
        counts = {}
        for name in ("td3_strength", "front_door", "front_door_gamma"):
            runs = pd.read_csv(ROOT / "results" / f"{name}.csv")
            failed = runs[runs["return"] < -200].groupby(["algorithm", "method"]).size()
            counts[name] = {"/".join(key): number for key, number in failed.items()}
        assert counts["td3_strength"] == {"TD3/smooth": 7, "TD3/smooth 0.1": 2, "TD3/smooth 0.3": 1}
        baselines = {"SAC/baseline": 1, "TD3/baseline": 1}
        assert counts["front_door_gamma"] == {**baselines, "SAC/smooth": 2, "TD3/smooth": 2}
        assert counts["front_door"]["TD3/smooth"] == 1 and counts["front_door"]["SAC/smooth"] == 4
        pairs = runs.pivot(index=["algorithm", "seed"], columns="method", values="return")
        learned = pairs[(pairs >= -200).all(axis=1)].groupby("algorithm").mean().round()
        assert learned.loc["SAC"].to_list() == [-126, -134]
        assert learned.loc["TD3"].to_list() == [-126, -126]

    def test_sacs_advice_for_short_trainings(self):
        """The rule of results/front_door.md, and the sentence on runs that do not learn."""
        runs = pd.read_csv(ROOT / "results" / "sac_strength.csv").groupby("method")
        failed = runs["return"].apply(lambda returns: (returns < -200).sum())
        assert failed[failed > 0].to_dict() == {"baseline": 1, "smooth": 1}
        returned = runs["return"].mean()
        free = returned.index[(returned >= 1.1 * returned["baseline"]) & (failed <= 1)]
        varied = runs["action_variation"].mean()[free].drop("baseline")
        assert len(varied) == 4 and varied.idxmin() == "smooth relative"

    def test_td3s_strength(self):
        """The rule on the last policies, its consequence on seeds 0 to 9, and the sentences."""
        page = " ".join((ROOT / "results" / "td3.md").read_text().split())
        groups = td3.by_setting(records("td3").query("seed >= 110"))
        assert td3.chosen(groups)["L2C2"] == 0.3
        chosen, baseline = groups["L2C2", 0.3], groups[td3.BASELINE]
        assert len(chosen.seeds) == len(baseline.seeds) == 20
        assert td3.failures(chosen) == td3.failures(baseline) == 0
        assert td3.failures(groups["L2C2", 1.0]) == 3
        means = {
            setting: {
                quantity: group.scores("last_mean", quantity).mean()
                for quantity in ("return", "action_variation")
            }
            for setting, group in groups.items()
        }
        ours, plain = means["L2C2", 0.3], means[td3.BASELINE]
        assert abs(ours["return"] - plain["return"]) < 0.01 * abs(plain["return"])
        lower = 1 - ours["action_variation"] / plain["action_variation"]
        assert f"the mean action variation is {lower:.0%} lower" in page
        shown = td3.by_setting(records("td3").query("seed < 10"))
        kept, before = (shown["L2C2", each].scores("last_mean", "return") for each in (0.3, 1.0))
        assert kept.mean() >= before.mean()
        assert f"({kept.mean():.1f} and {before.mean():.1f})" in page
        assert [td3.failures(shown["L2C2", each]) for each in (0.3, 1.0)] == [2, 1]
        smooth, rough = (
            shown[each].scores("last_mean", "action_variation").mean()
            for each in (td3.PRESETS["L2C2"], td3.BASELINE)
        )
        ours = shown[td3.PRESETS["L2C2"]].runs.set_index("seed")
        poor = ours[ours["last_mean_return"] < td3.FAILED]["late_mean_return"].round()
        assert poor.to_dict() == {4: -166, 8: -143}
        assert f"by {1 - smooth / rough:.0%}, from {rough:.3f} to {smooth:.3f}" in page
        (again,) = group_records(records("td3_again"))
        assert again.seeds == list(range(10)) and td3.failures(again) == 1
        assert td3.failures(shown["CATS", 1.0]) == td3.failures(shown["CAPS", 1.0]) == 0
        assert td3.failures(shown[td3.PRESETS["CATS"]]) == 1
        assert td3.chosen(groups) == {"L2C2": 0.3, "CATS": 0.1, "CAPS": 0.1}
        cats = [groups["CATS", each] for each in td3.STRENGTHS]
        assert sum(len(each.seeds) for each in cats) == 60
        assert not any(td3.failures(each) for each in cats)
        for method in ("CATS", "CAPS"):
            kept, before = (shown[method, s].scores("last_mean", "return") for s in (0.1, 1.0))
            assert f"({kept.mean():.1f} and {before.mean():.1f})" in page
            assert kept.mean() < before.mean()

    def test_td3_on_a_mujoco_task(self):
        """How many runs shake with each method, and what this costs."""
        page = (ROOT / "results" / "td3_mujoco.md").read_text()
        start = " ".join(page.partition("<!-- results: start -->")[0].split())
        runs = records("td3_mujoco").query("seed < 10")
        runs["method"] += np.where(runs["differences"].str.contains("relative"), ", relative", "")
        shakes = runs["last_mean_action_variation"] > 0.2
        found = runs.groupby("method")["last_mean_action_variation"]
        assert shakes.groupby(runs["method"]).agg(["sum", "count"]).to_dict("index") == {
            "none": {"sum": 3, "count": 5},
            "l2c2": {"sum": 4, "count": 5},
            "l2c2, relative": {"sum": 0, "count": 5},
            "cats": {"sum": 0, "count": 5},
            "cats, relative": {"sum": 0, "count": 5},
        }
        assert f"change their action by {found.mean()['l2c2, relative']:.3f} per step" in start
        assert f"the baseline's by {found.mean()['none']:.2f}." in start
        decided = records("relative").query("task == 'InvertedDoublePendulum-v5'")
        decided = decided[decided["differences"].str.contains("relative")].query("method == 'l2c2'")
        assert (decided["last_mean_action_variation"] > 0.2).to_list().count(True) == 1
        assert "one of five runs with the preset shakes" in start and len(decided) == 5
        most = math.ceil(100 * found.max()["cats, relative"]) / 100
        assert f"With the preset of CATS it changes by at most {most}." in start
        returned = runs["last_mean_return"]
        assert (
            f"costs at most {1 - returned[shakes].min() / returned.max():.1%} of the return"
            in start
        )

    def test_td3_on_a_mujoco_task_at_four_times_the_strength(self):
        """How many runs shake on these seeds, and on all seeds at the preset."""
        page = " ".join((ROOT / "results" / "td3_mujoco.md").read_text().split())
        runs = records("td3_mujoco_strength").query("method == 'l2c2'")
        strong = runs["differences"].str.contains("strength=4")
        shakes = runs["last_mean_action_variation"] > 0.2
        assert [(int(shakes[s].sum()), int(s.sum())) for s in (~strong, strong)] == [(2, 5), (0, 5)]
        assert "two of five runs shake at strength 1, and none at strength 4, at a higher" in page
        returned = runs["last_mean_return"]
        assert returned[strong].mean() > returned[~strong].mean()
        first = records("td3_mujoco").query("method == 'l2c2' and seed < 10")
        first = first[~first["differences"].str.contains("relative")]
        assert int((first["last_mean_action_variation"] > 0.2).sum()) + shakes[~strong].sum() == 6
        assert "six of ten shake at strength 1, and five of ten baselines" in page
        baselines = pd.concat([records("td3_mujoco"), records("td3_mujoco_strength")])
        baselines = baselines.query("method == 'none'")["last_mean_action_variation"]
        assert (int((baselines > 0.2).sum()), len(baselines)) == (5, 10)

    def test_td3s_strengths_are_relative_to_fixed_gains(self):
        """A run with the present preset has the strength of the same run before it changed."""
        runs = records("td3").query("seed < 10 and method == 'l2c2'").copy()
        runs = runs[~runs["differences"].str.contains("relative")]
        before = runs["differences"]
        assert before.str.contains("regularizer.strength=0.3").all()
        runs["differences"] = before.str.replace("lambda_min=10 ", "lambda_min=3 ").str.replace(
            "regularizer.strength=0.3 ", ""
        )
        assert list(td3.by_setting(runs)) == [("L2C2", 0.3)]
        runs["settings"] = "another"
        with pytest.raises(ValueError, match="Expected one setting of L2C2, `lambda_min=3`"):
            td3.by_setting(pd.concat([records("td3").query("seed < 10"), runs]))

    def test_td3s_presets_are_those_of_the_table(self):
        """Strengths times the gains."""
        for method, (tried, factor) in td3.PRESETS.items():
            expected = preset(method.lower(), "td3")
            assert tried.endswith(td3.RELATIVE) == expected.relative
            gains = td3.GAINS[tried]
            names = ("lambda_min",) if method == "L2C2" else ("lambda_temporal", "lambda_spatial")
            for name, gain in zip(names, gains, strict=False):
                assert expected.settings[name] == pytest.approx(factor * gain)

    def test_walkings_gains(self):
        """Every run of the seeds that its gains are chosen on is a cell."""
        page = (ROOT / "results" / "field_gains.md").read_text()
        one = records("one_gain")
        shown = merge(records("walker2d_gains"), one[one["task"] == "walker2d_v5"])
        for record in shown.itertuples():
            cell = f"{record.last_mean_return:.0f} / {record.last_mean_sm_asap:.3f}"
            assert f"| {cell} |" in page
        assert len(shown) >= 24


class TestForest:
    @pytest.fixture
    def shown(self, tmp_path):
        """Two tasks with two runs of each side: returns and action variations by task."""
        results = {
            "swingup": ([(1.0, 0.2), (3.0, 0.2)], [(2.0, 0.3), (2.0, 0.4)]),
            "reacher": ([(1.0, 0.1), (1.0, 0.3)], [(2.0, 0.2), (2.0, 0.2)]),
        }
        for task, sides in results.items():
            for method, runs in zip(("l2c2", "none"), sides, strict=True):
                for seed, result in enumerate(runs):
                    config = make_config(task=task, regularizer=method, seed=seed)
                    make_run(tmp_path / task / method / str(seed), config, *result)
        groups = {
            (g.first.task, g.first.method): g
            for g in group_records(records_of(read_runs(tmp_path)))
        }
        return forest.rows(
            {(t, "PPO"): (groups[t, "l2c2"], groups[t, "none"]) for t in ("swingup", "reacher")}
        )

    def test_by_hand(self, shown):
        """Swingup: all four pairs are smoother; one of two returns is above 2, and a resample has
        none, one or both with 1/4, 1/2 and 1/4, so the interval is [0, 1]. Reacher: as many pairs
        are smoother as not, with the same interval, and no return is larger."""
        assert forest.table(shown).splitlines()[2:] == [
            "| swingup, PPO (2 seeds) | 1.00 [1.00, 1.00] | 0.50 [0.00, 1.00] |",
            "| reacher, PPO (2 seeds) | 0.50 [0.00, 1.00] | 0.00 [0.00, 0.00] |",
            "| Mean of the 2 rows | 0.75 [0.50, 1.00] | 0.25 [0.00, 0.50] |",
        ]

    def test_the_picture_needs_no_font_and_is_the_same_every_time(self, shown, tmp_path):
        """Letters are outlines; the description has the numbers."""
        first, second = tmp_path / "first.svg", tmp_path / "second.svg"
        for path in (first, second):
            forest.draw(shown, path)
        text = first.read_text()
        assert text == second.read_text() and "<text" not in text
        assert forest.table(shown) in text

    def test_picture_and_sentences_are_of_the_records(self):
        """The mean over the rows, and the two losses of return beyond seed noise."""
        shown = forest.rows(benchmarks())
        assert forest.table(shown) in forest.PICTURE.read_text()
        *rows, overall = shown
        assert overall.label == f"Mean of the {len(rows)} rows"
        smoother, returned = (each.text("{:.2f}".format) for each in overall.better)
        for path in ("results/README.md", "docs/results.md"):
            start = " ".join((ROOT / path).read_text().partition("![")[0].split())
            assert f"Over {len(rows)} benchmarks" in start
            assert f"smoother than a run of the baseline with a probability of {smoother}." in start
            assert f"returns more with a probability of {returned}, which is within" in start
        low, high = overall.better[1].interval
        assert low < 0.5 < high
        lost = [row.label for row in rows if row.better[1].interval[1] < 0.5]
        risen = [row.label.partition(" (")[0] for row in rows if row.better[1].interval[0] > 0.5]
        names = ["Ant, PPO", "InvertedDoublePendulum, TD3", "BipedalWalker, PPO", "Swimmer, PPO"]
        names += ["noisy Reacher, PPO-RPE"]
        assert risen == names
        assert lost == ["noisy points, PPO of rsl_rl (5 seeds)"]


class TestStrength:
    @pytest.fixture
    def shown(self, tmp_path):
        """Two seeds of the baseline and of two strengths; the third run is for choosing."""
        l2c2 = REGULARIZERS["l2c2"]
        sides = {
            "none": (NoRegularizerConfig(), 0.4),
            "weak": (replace(l2c2, strength=0.1), 0.3),
            "one": (l2c2, 0.2),
        }
        for name, (regularizer, variation) in sides.items():
            for seed in (0, 1, 100):
                config = make_config(regularizer=regularizer, seed=seed)
                make_run(tmp_path / name / str(seed), config, float(seed), variation)
        return strength.curves(records_of(read_runs(tmp_path)))

    def test_rows_by_hand(self, shown):
        """Of the last policy with mean actions: 20 more, and 0.020."""
        (curve,) = shown
        assert list(curve.groups) == [0.0, 0.1, 1.0]
        assert curve.means("action_variation") == pytest.approx([0.42, 0.32, 0.22])
        assert [line.split(" | ")[:4] for line in strength.table(shown).splitlines()[2:]] == [
            ["| swingup, ppo_rpe", name, "0, 1", "20.50"] for name in ("0 (baseline)", "0.1", "1")
        ]

    def test_two_settings_of_one_strength_are_refused(self, tmp_path):
        """One would replace the other."""
        for name, regularizer in (("one", "l2c2"), ("two", L2C2Config(beta=0.5))):
            make_run(tmp_path / name, make_config(regularizer=regularizer), 1.0, 0.1)
        with pytest.raises(ValueError, match="Expected one setting of swingup, ppo_rpe at"):
            strength.curves(records_of(read_runs(tmp_path)))

    def test_the_picture_has_its_numbers(self, shown, tmp_path):
        """And no letter that needs a font."""
        strength.draw(shown, tmp_path / "a.svg")
        text = (tmp_path / "a.svg").read_text()
        assert strength.table(shown) in text and "<text" not in text

    def test_page_and_picture_are_of_the_records(self):
        """``python -m studies.strength`` would change nothing."""
        table = strength.table(strength.curves(strength.shown()))
        assert table in strength.PAGE.read_text() and table in strength.PICTURE.read_text()
        assert choice_table(strength.candidates()).markdown() in strength.PAGE.read_text()

    def test_the_page_has_the_ratios_of_the_table(self):
        """Of the means over three seeds, for each task."""
        found = {curve.label: curve for curve in strength.curves(strength.shown())}
        ratios = {}
        for task in ("hopper_v5", "lunarlander"):
            curve = found[f"{task}, ppo"]
            assert all(len(group.runs) == 3 for group in curve.groups.values())
            sm = dict(zip(curve.groups, curve.means("sm_asap"), strict=True))
            ratios[task] = {at: value / sm[0.0] for at, value in sm.items()}
        page = " ".join(strength.PAGE.read_text().split())
        said = "Sm falls to {:.2f} of the baseline at a strength of 0.1, to {:.2f} at the preset's"
        assert said.format(*(ratios["hopper_v5"][at] for at in (0.1, 1.0))) in page
        assert f"strength of 1, and to {ratios['hopper_v5'][10.0]:.2f} at 10" in page
        assert f"where Sm is {ratios['lunarlander'][1.0]:.2f} of the baseline" in page
        assert f"with 0.66 and {ratios['hopper_v5'][0.3]:.2f} of its Sm" in page
        guide = " ".join((ROOT / "docs" / "strength.md").read_text().split())
        assert "10 has half of the preset's [Sm](smoothness.md)" in guide
        assert ratios["hopper_v5"][10.0] / ratios["hopper_v5"][1.0] == pytest.approx(0.5, abs=0.05)

    def test_seeds_are_beside_their_own(self):
        """Where a method lacks a seed, its cell is empty."""
        runs = records("runs")
        lacking = ~((runs["method"] == "none") & (runs["seed"] == 3))
        whole, cut = (pages.reacher_by_seed(each).splitlines() for each in (runs, runs[lacking]))
        assert [line for line in cut if not line.startswith("| 3 ")] == [
            line for line in whole if not line.startswith("| 3 ")
        ]
        (row,) = (line for line in cut if line.startswith("| 3 "))
        assert row.split("|")[2].strip() == ""

    def test_no_weaker_preset_by_the_rule(self):
        """On Pendulum every strength returns more than 5% less than the baseline."""
        found = strength.candidates()
        given = found["differences"].str.extract(r"regularizer\.strength=([\d.]+)")[0].fillna("1")
        named = given.where(found["method"] != "none", "baseline")
        means = found.groupby(["task", named]).mean(numeric_only=True)
        assert found.groupby(["task", named]).size().loc[["pendulum", "lunarlander"]].eq(5).all()
        total = means["last_mean_return"].loc["pendulum"]
        lost = (total["baseline"] - total.drop("baseline")) / abs(total["baseline"])
        assert list(lost.index) == ["0.1", "0.3", "1"] and (lost > 0.05).all()
        page = " ".join(strength.PAGE.read_text().split())
        assert f"at strength 0.1 is {lost['0.1']:.1%} below the baseline" in page
        assert f"at 1 the return is {lost['1']:.0%} below" in page
        sm = means["last_mean_sm_asap"].unstack("task")[["pendulum", "lunarlander"]]
        ratios = np.exp(np.log(sm / sm.loc["baseline"]).mean(axis=1))
        said = "Sm is {:.2f} (strength 0.1) and {:.2f} (0.3) of the baseline's, and {:.2f} at"
        assert said.format(*ratios[["0.1", "0.3", "1"]]) in page


class TestTrace:
    def test_a_row_shows_the_busiest_joint_and_its_mean_change(self, tmp_path):
        """By hand: from -1 to 1 and back is a change of 2 per step; a constant has none."""
        steps = np.arange(700)
        shaking = np.stack([0.0 * steps, (-1.0) ** steps], 1)
        still = np.stack([0.0 * steps, 0.0 * steps], 1)
        for path in (tmp_path / "one.svg", tmp_path / "two.svg"):
            trace.draw([shaking, still], ["PPO", "PPO with L2C2"], path)
        content = (tmp_path / "one.svg").read_text()
        assert content == (tmp_path / "two.svg").read_text()
        assert "<!-- PPO, right knee: mean change per step 2.00 -->" in content
        assert "<!-- PPO with L2C2, right hip: mean change per step 0.00 -->" in content

    def test_two_runs_are_played_and_drawn(self, tmp_path):
        """The actions are those of the first test episode."""
        task = TaskConfig("pendulum", "Pendulum-v1", episodes=1, max_steps=30)
        for name in ("none", "l2c2"):
            experiment = Experiment(ExperimentConfig(task=task, compile=False), tmp_path / name)
            experiment.train()
            tested = experiment.test(1)
            experiment.finish(tested)
            played = trace.actions_of(tmp_path / name)
            change = np.abs(np.diff(played, axis=0)).mean()
            assert change == pytest.approx(tested.action_variations[0], rel=1e-4)
            experiment.close()
        trace.main([str(tmp_path / "none"), str(tmp_path / "l2c2"), str(tmp_path / "a.svg")])
        assert (tmp_path / "a.svg").stat().st_size > 1000


class TestHalfCheetah:
    def test_runs_of_the_task_are_played(self, tmp_path, monkeypatch):
        """A policy at rest stays upright; runs of other tasks are left out."""
        for name, env_id in (("cheetah", "HalfCheetah-v5"), ("swimmer", "Swimmer-v5")):
            task = TaskConfig(env_id, env_id=env_id, episodes=4, max_steps=5)
            config = ExperimentConfig(task=task, regularizer=L2C2Config())
            make_run(tmp_path / name, config, 1.0, 0.1)
        monkeypatch.setattr(half_cheetah, "act", lambda run: lambda seen: np.zeros(6, np.float32))
        path = tmp_path / "half_cheetah.csv"
        path.write_text("method,seed,return,on_back,commit\nl2c2,0,9,1,c\nnone,10,8,1,c\n")
        half_cheetah.main(tmp_path, path)
        played, other = pd.read_csv(path).to_dict("records")
        assert played["method"] == "l2c2" and played["on_back"] == 0.0
        assert abs(played["return"]) < 5
        assert list(other.values()) == ["none", 10, 8, 1, "c"]

    def test_the_table_by_hand(self, tmp_path):
        """Seeds in order, methods in the order of tables."""
        lines = ["method,seed,return,on_back,commit", "l2c2,1,10,1,c", "l2c2,0,20.6,0.004,c"]
        lines += ["none,0,7,0.985,c", "none,1,8,0,c", "cats,0,3,0,c", "cats,1,4,0.5,c"]
        (tmp_path / "runs.csv").write_text("\n".join(lines))
        assert half_cheetah.table(tmp_path / "runs.csv").splitlines()[2:] == [
            "| baseline | 7, 8 | 99%, 0% |",
            "| L2C2 | 21, 10 | 0%, 100% |",
            "| CATS | 3, 4 | 0%, 50% |",
        ]
        assert "seeds 0, 1" in half_cheetah.table(tmp_path / "runs.csv")
