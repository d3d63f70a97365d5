"""Groups, tables, statistics and pictures of runs: of made-up folders, by numbers known by hand."""

from __future__ import annotations

import csv
import json
import math
import os
import re
import statistics
import subprocess
import tracemalloc
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import mannwhitneyu, trim_mean

from torchrl_l2c2.experiment import (
    ExperimentConfig,
    L2C2Config,
    PPOConfig,
    PPORPEConfig,
    SACConfig,
    TD3Config,
)
from torchrl_l2c2.experiment.optimizers import AdamConfig
from torchrl_l2c2.experiment.regularizers import REGULARIZERS
from torchrl_l2c2.experiment.reports import (
    draw_learning_curves,
    draw_plane,
    find_runs,
    read_records,
    read_runs,
    sweep_summary,
    write_records,
    write_report,
)
from torchrl_l2c2.experiment.reports.__main__ import main
from torchrl_l2c2.experiment.reports.against import against_table
from torchrl_l2c2.experiment.reports.choice import choice_table
from torchrl_l2c2.experiment.reports.comparison import improvement, statistics_tables, summary
from torchrl_l2c2.experiment.reports.differences import differences, fingerprint
from torchrl_l2c2.experiment.reports.faster_targets import faster_targets_table
from torchrl_l2c2.experiment.reports.field import BETTER, field_groups, field_table
from torchrl_l2c2.experiment.reports.gain_targets import gain_targets_table
from torchrl_l2c2.experiment.reports.groups import (
    baseline_of,
    comparable,
    group_records,
    over_tasks,
)
from torchrl_l2c2.experiment.reports.measures import measures_table
from torchrl_l2c2.experiment.reports.page import (
    END,
    START,
    START_TABLE,
    field_results,
    fill,
    paper_results,
    shown_groups,
)
from torchrl_l2c2.experiment.reports.pairwise import pairwise_tables
from torchrl_l2c2.experiment.reports.paper import TAU
from torchrl_l2c2.experiment.reports.paper_table import deployed_table, paper_table
from torchrl_l2c2.experiment.reports.records import TESTS, digest, merge
from torchrl_l2c2.experiment.reports.runs import FinishedRun, finished_run
from torchrl_l2c2.experiment.reports.score import readings
from torchrl_l2c2.experiment.reports.statistics import (
    bootstrap_interval,
    curve_band,
    interquartile_mean,
    mean,
    mean_and_deviation,
    probability_of_improvement,
)
from torchrl_l2c2.experiment.reports.tables import number_range, results_tables
from torchrl_l2c2.experiment.tasks import TASKS
from torchrl_l2c2.experiment.versions import code_commit

ROOT = Path(__file__).parents[1]
METHODS = {
    "vanilla": REGULARIZERS["none"],
    "CAPS": REGULARIZERS["caps"],
    "L2C2": REGULARIZERS["l2c2"],
    "L2C2, beta=0.5": L2C2Config(beta=0.5),
}


def make_config(*, task="swingup", regularizer="none", episodes=20, seed=0, **settings):
    method = (
        REGULARIZERS.get(regularizer, regularizer) if isinstance(regularizer, str) else regularizer
    )
    return ExperimentConfig(
        task=replace(TASKS[task], episodes=episodes), regularizer=method, seed=seed, **settings
    )


def make_run(folder, config, total, variation):
    """A finished run's folder whose figures are simple sums.

    Returns: sampled and late ``total``; mean and late ``total + 12``; of the last policy ``total +
    20`` with its mean and ``total + 30`` with samples. Action variations likewise in thousandths.
    """
    folder.mkdir(parents=True)
    rows = []
    for episode in range(1, config.task.episodes + 1):
        last_but = config.task.episodes - episode
        late = last_but < 2
        rows.append(
            {
                "episode": episode,
                "frames": 100 * episode,
                "updates": 10 * episode,
                # Late, 1 more and 1 less; before, far off.
                "return": total + (1 if last_but else -1) if late else -1e6,
                "action_variation": variation if late else 9.0,
                "policy_scale": 0.5 if late else 7.0,
                "test_return": total + 12 + (2 if last_but else -2) if late else math.nan,
                "test_action_variation": variation + 0.012 if late else math.nan,
                "frames_per_second": 50.0,
            }
        )
    with open(folder / "metrics.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)

    def test(more):
        summary = {
            "episodes": 2,
            "return_mean": total + more,
            "return_std": 0.0,
            "action_variation_mean": variation + more / 1000,
            "action_variation_std": 0.0,
        }
        return {"summary": summary}

    (folder / "config.json").write_text(json.dumps(config.to_dict()))
    (folder / "evaluation.json").write_text(json.dumps({**test(20), "sampled": test(30)}))
    (folder / "versions.json").write_text(json.dumps({"torch": "2.15.0", "commit": "abc"}))


@pytest.fixture(scope="module")
def forty(tmp_path_factory):
    """Two tasks, four methods, five seeds: ``100 m + seed`` of method m, half of it on Reacher."""
    folder = tmp_path_factory.mktemp("forty")
    for task, scale in (("swingup", 1.0), ("reacher", 0.5)):
        for m, (name, method) in enumerate(METHODS.items()):
            for seed in range(5):
                config = make_config(task=task, regularizer=method, seed=seed)
                place = folder / task / name / str(seed)
                make_run(place, config, scale * (100 * m + seed), 0.1 - 0.01 * m + 0.001 * seed)
    return folder


@pytest.fixture(scope="module")
def records(forty):
    return [run.record for run in read_runs(forty)]


def cells(table, *start):
    """The cells of the only row that starts so."""
    (row,) = (list(row) for row in table.rows if tuple(row[: len(start)]) == start)
    return row[len(start) :]


class TestPaperTable:
    def test_its_probabilities_are_of_all_pairs_with_vanilla(self, tmp_path):
        """Of returns 15 and 25 beside 10 and 20 three of four are larger; a tie is a half."""
        runs = {"none": ((10.0, 0.1), (20.0, 0.1)), "l2c2": ((15.0, 0.1), (25.0, 0.05))}
        for method, results in runs.items():
            for seed, result in enumerate(results):
                config = make_config(regularizer=method, seed=seed)
                make_run(tmp_path / method / str(seed), config, *result)
        make_run(tmp_path / "sac", make_config(algorithm=SACConfig()), 99.0, 0.1)
        groups = group_records(run.record for run in read_runs(tmp_path))
        table = paper_table(groups)
        assert [row[:2] for row in table.rows] == [["swingup", "vanilla"], ["swingup", "L2C2"]]
        row = dict(zip(table.columns, table.rows[1], strict=True))
        assert row["P(returns more)"].split()[0] == "0.75"
        assert row["P(smoother)"].split()[0] == "0.75"
        assert table.rows[1][3:6] == ["20.00 (7.07)†", "693.8 (123.8)", "50.00 (7.07)"]
        assert table.rows[0][6] == table.rows[0][-2] == ""
        assert paper_table([group for group in groups if group.first.algorithm == "sac"]) is None

    @pytest.mark.parametrize(("total", "marks"), [(693.0 + 123.0, 0), (693.0 - 126.0, 1)])
    def test_a_cell_beyond_the_papers_deviation_is_marked(self, tmp_path, total, marks):
        """The paper's L2C2 on Swingup: 693.77 (123.78) at .075 (.012); .08 lies within."""
        make_run(tmp_path / "run", make_config(regularizer="l2c2"), total, 0.08)
        (row,) = paper_table(group_records(run.record for run in read_runs(tmp_path))).rows
        assert "".join(row).count("†") == marks

    def test_the_late_policies_scale_stands_behind_them(self, tmp_path):
        """L2C2 can satisfy its distance by a wider policy: the mean over seeds, of any figure."""
        make_run(tmp_path / "run", make_config(regularizer="l2c2"), 700.0, 0.08)
        record = next(iter(read_runs(tmp_path))).record
        both = [replace(record, seed=s, policy_scale=v) for s, v in enumerate((0.2, 0.4))]
        table = paper_table(group_records(both))
        assert (table.columns[-1], table.rows[0][-1]) == ("policy scale", "0.300 (0.141)")

    def test_as_deployed_they_are_compared_by_their_mean_actions(self, tmp_path):
        """Other numbers than those of sampled actions, and other probabilities."""
        make_run(tmp_path / "run", make_config(), 10.0, 0.1)
        (record,) = (run.record for run in read_runs(tmp_path))
        figures = ("late_mean_return", "late_mean_action_variation")
        records = [
            replace(record, method=method, seed=seed, **dict(zip(figures, values, strict=True)))
            for method, runs in {
                "none": ((10.0, 0.5), (20.0, 0.5)),
                "l2c2": ((15.0, 0.4), (25.0, 0.6)),
            }.items()
            for seed, values in enumerate(runs)
        ]
        groups = group_records(records)
        plain, smooth = deployed_table(groups).rows
        assert plain[3:] == ["15.00 (7.07)", plain[4], "", "0.500 (0.000)", plain[7], ""]
        assert (smooth[3], smooth[6]) == ("20.00 (7.07)", "0.500 (0.141)")
        assert (smooth[5].split()[0], smooth[8].split()[0]) == ("0.75", "0.50")
        assert deployed_table(groups).markdown() in paper_results(records).details
        untested = [replace(record, **dict.fromkeys(figures, math.nan)) for record in records]
        assert deployed_table(group_records(untested)) is None

    def test_the_last_rows_are_the_means_over_tasks(self, records):
        """Of 1 on Swingup, and of a half on Reacher, where returns are vanilla's own."""
        vanilla = {(r.task, r.seed): r.late_sampled_return for r in records if r.method == "none"}
        equal = [
            replace(r, late_sampled_return=vanilla[r.task, r.seed])
            if (r.task, r.method) == ("reacher", "l2c2")
            else r
            for r in records
        ]
        table = paper_table(group_records(equal))
        better, smoother = map(table.columns.index, ("P(returns more)", "P(smoother)"))
        (row,) = (row for row in table.rows if row[:2] == ["2 tasks", "L2C2"])
        assert (row[better].split()[0], row[smoother].split()[0]) == ("0.75", "1.00")
        assert not any(cell for i, cell in enumerate(row[2:], 2) if i not in (better, smoother))
        of_mean = [row for row in deployed_table(group_records(equal)).rows if row[1] == "L2C2"]
        assert (of_mean[-1][0], of_mean[-1][5].split()[0]) == ("2 tasks", "1.00")


class TestFasterTargets:
    def test_they_are_beside_the_papers_returns(self, tmp_path):
        """376 and 284 at tau .5, Table III's at .1; other methods and other paces have none."""
        for tau in (0.1, 0.5, 0.3):
            for method, total in (("l2c2", 300.0), ("l2c2_policy", 200.0), ("caps", 100.0)):
                for seed in range(2):
                    settings = {"algorithm": PPORPEConfig(tau=tau), "seed": seed, "episodes": 350}
                    config = make_config(regularizer=method, **settings)
                    folder = tmp_path / f"{tau}" / method / str(seed)
                    make_run(folder, config, total + 10 * seed - 100 * tau, 0.1)
        records = [run.record for run in read_runs(tmp_path)]
        table = faster_targets_table(records)
        of_rows = {row[1]: (row[3].split()[0], *row[5:]) for row in table.rows}
        assert of_rows == {
            "L2C2": ("295.0", "693.8", "1.00 [1.00, 1.00]"),
            "L2C2, beta=0": ("195.0", "707.4", ""),
            "L2C2, tau=0.3": ("275.0", "", "1.00 [1.00, 1.00]"),
            "L2C2, beta=0, tau=0.3": ("175.0", "", ""),
            "L2C2, tau=0.5": ("255.0", "376.0", "1.00 [1.00, 1.00]"),
            "L2C2, beta=0, tau=0.5": ("155.0", "284.0", ""),
        }
        assert table.markdown() in paper_results(records).details
        # And Table III is not of them.
        beside = paper_table(group_records(records))
        published = {row[1]: row[4] for row in beside.rows}
        assert published["L2C2"] == "693.8 (123.8)" and published["L2C2, tau=0.5"] == ""
        usual = [record for record in records if "tau" not in record.differences]
        assert faster_targets_table(usual) is None


class TestMeasures:
    def test_they_are_pooled_over_seeds_where_runs_have_them(self, tmp_path):
        """Means of 1 and 2: 1.5 with a deviation of .71; a run of before has none."""
        for seed in range(3):
            make_run(tmp_path / str(seed), make_config(seed=seed), 10.0, 0.1)
            path = tmp_path / str(seed) / "evaluation.json"
            content = json.loads(path.read_text())
            if seed:
                content["summary"] |= {"roughness_mean": float(seed), "saturation_mean": math.nan}
            path.write_text(json.dumps(content))
        runs = read_runs(tmp_path)
        table = measures_table(runs)
        assert cells(table, "swingup", "ppo_rpe", "vanilla") == [
            "0-2",
            "1.5 (0.71), of 2 runs",
            "-",
        ]
        assert table.columns[-2:] == ["roughness", "at the bounds"]
        page = write_report(tmp_path / "report", [run.record for run in runs], runs)
        assert "1.5 (0.71)" in page.read_text()
        assert measures_table(runs[:1]) is None


class TestFieldTable:
    def test_it_has_what_was_published_beside_the_means_over_seeds(self, tmp_path):
        """Of those tasks with PPO and SAC alone; an interval from two runs on; ties are halves."""
        preset = {"task": "hopper_v5", "algorithm": PPOConfig()}
        for method, seeds in (("none", 1), ("caps", 2), ("l2c2_ramp", 1)):
            for seed in range(seeds):
                folder = tmp_path / method / str(seed)
                make_run(folder, make_config(regularizer=method, seed=seed, **preset), 100.0, 0.1)
                path = folder / "evaluation.json"
                content = json.loads(path.read_text())
                content["summary"] |= {"sm_asap_mean": 0.4 + 0.2 * seed}
                path.write_text(json.dumps(content))
        make_run(tmp_path / "paper", make_config(), 10.0, 0.1)
        records = [run.record for run in read_runs(tmp_path)]
        write_records(tmp_path / "runs.csv", records)
        table = field_table(read_records(tmp_path / "runs.csv"))
        assert cells(table, "hopper_v5", "ppo", "CAPS") == [
            "0, 1",
            "120.0 [120.0, 120.0]",
            "0.500 [0.400, 0.600]",
            "0.120 [0.120, 0.120]",
            "0.50",  # Vanilla has a single run, which says nothing of how runs vary.
            "0.25",
            "2440",
            "0.471",
        ]
        alone = ["0", "120.0", "0.400", "0.120", "0.50", "0.50", "", ""]
        assert cells(table, "hopper_v5", "ppo", "L2C2, means, ramp") == alone
        assert cells(table, "hopper_v5", "ppo", "LipsNet++") == [*[""] * 6, "1878", "0.543"]
        assert len(table.rows) == 8  # CAPS and vanilla once, as they were run
        assert {row[0] for row in table.rows} == {"hopper_v5"}
        # With noise, or shorter episodes, it is another task.
        other = [replace(r, differences="task.max_steps=60") for r in records]
        assert all(row[-2:] == ["", ""] for row in field_table(other).rows if row[3])
        assert "2440" in sweep_summary([tmp_path])
        write_report(tmp_path / "report", records)
        picture = (tmp_path / "report" / "plane_field.svg").read_text()
        # Vanilla's and CAPS's, of which something was published; caps of intervals are lines.
        hollow = picture.count("fill: #ffffff; fill-opacity: 0.8")
        assert ">Sm<" in picture and hollow == 2
        assert field_table([run.record for run in read_runs(tmp_path / "paper")]) is None


class TestChoiceTable:
    def test_settings_are_ordered_over_tasks_beside_vanilla(self, tmp_path):
        """By hand: returns by 10 and by -25 of 100, Sm half and twice; another at .8 and .8."""
        shares = {s: L2C2Config(gain="target", gain_target=s) for s in (0.1, 0.3)}
        cases = {
            "pendulum": {"none": (-100.0, 0.4), 0.1: (-90.0, 0.2), 0.3: (-100.0, 0.32)},
            "lunarlander": {"none": (100.0, 0.4), 0.1: (75.0, 0.8), 0.3: (110.0, 0.32)},
        }
        for task, methods in cases.items():
            for method, (total, sm) in methods.items():
                # Vanilla has a seed of its own, which does not count.
                for seed in range(3 if method == "none" else 2):
                    config = make_config(
                        task=task,
                        algorithm=PPOConfig(),
                        regularizer=shares.get(method, method),
                        seed=seed,
                    )
                    folder = tmp_path / task / str(method) / str(seed)
                    make_run(folder, config, total, 0.1)
                    path = folder / "evaluation.json"
                    content = json.loads(path.read_text())
                    off = 10.0 * seed - 5.0 if seed < 2 else 1000.0
                    content["summary"] |= {"return_mean": total + off, "sm_asap_mean": sm}
                    path.write_text(json.dumps(content))
        table = choice_table([run.record for run in read_runs(tmp_path)])
        # Of all pairs of these seeds: returns of .1 win 3.5 of 4 and none, of .3 2 and 3.5 of 4.
        assert [[*row[:-2], *(cell.split()[0] for cell in row[-2:])] for row in table.rows] == [
            ["ppo", f"L2C2, gain_target={share}", "pendulum, lunarlander", "0, 1", *cells]
            for share, cells in {
                0.3: ["+5%", "+0% pendulum", "0.80", "0.80 pendulum", "0.69", "1.00"],
                0.1: ["-8%", "-25% lunarlander", "1.00", "2.00 lunarlander", "0.44", "0.50"],
            }.items()
        ]
        told = sweep_summary([tmp_path])
        assert "-25% lunarlander" in told
        records = [run.record for run in read_runs(tmp_path)]
        others = [replace(r, length="9 episodes") for r in records if r.method == "none"]
        # Vanilla of another length on one task takes no row apart.
        assert choice_table([*records, *(r for r in others if r.task == "pendulum")]) == table
        # .3 beside .1: a half of 4 pairs of Pendulum and all of LunarLander's; Sm of these alone.
        pairwise = pairwise_tables(records)
        assert [each.title.split(",")[0] for each in pairwise] == [*BETTER.values()]
        first, last = (f"L2C2, gain_target={share}" for share in (0.1, 0.3))
        for each, better in zip(pairwise, (0.56, 0.50), strict=True):
            assert [*each.columns] == ["method", "vanilla", first, last]
            cells = {row[0]: dict(zip(each.columns, row, strict=True)) for row in each.rows}
            assert cells[last][first].split()[0] == f"{better:.2f}"
            assert cells[first][last].split()[0] == f"{1 - better:.2f}"
            assert [cells[name][name] for name in cells] == ["", "", ""]
            assert each.markdown() in told

    def test_without_vanilla_there_is_nothing_to_compare(self, tmp_path):
        """Nor on the paper's tasks."""
        make_run(tmp_path / "a", make_config(task="pendulum", algorithm=PPOConfig()), 1.0, 0.1)
        make_run(tmp_path / "b", make_config(regularizer="none"), 1.0, 0.1)
        make_run(tmp_path / "c", make_config(), 1.0, 0.1)
        assert choice_table([run.record for run in read_runs(tmp_path)]) is None


class TestGroups:
    def test_forty_runs_are_eight_groups_with_the_figures_by_hand(self, records):
        """Seeds are pooled, nothing else; means and deviations of 0 to 4: 2 and 1.58."""
        late, last = results_tables(group_records(records))
        assert [row[:4] for row in late.rows] == [
            [task, "ppo_rpe", name, "0-4"] for task in ("swingup", "reacher") for name in METHODS
        ]
        # L2C2, the third: 200 + 2, and 12 more where the mean acts.
        assert cells(late, "swingup", "ppo_rpe", "L2C2", "0-4") == [
            "214.0 (1.6)",
            "202.0 (1.6)",
            "0.094 (0.002)",
            "0.082 (0.002)",
        ]
        assert cells(last, "swingup", "ppo_rpe", "L2C2", "0-4") == [
            "222.0 (1.6)",
            "232.0 (1.6)",
            "0.102 (0.002)",
            "0.112 (0.002)",
        ]
        assert cells(late, "reacher", "ppo_rpe", "vanilla", "0-4")[:2] == [
            "13.00 (0.79)",
            "1.00 (0.79)",
        ]

    def test_what_differs_in_the_regularizer_alone_is_together(self, records):
        """Other settings set groups apart; the names leave out what all have in common."""
        swingup = [r for r in records if r.task == "swingup"]
        mean = [
            replace(
                r,
                settings=f"m{r.settings}",
                differences=f"algorithm.reduction=mean {r.differences}",
            )
            for r in swingup
        ]
        groups, names = group_records([*records, *mean]), list(METHODS)
        assert [(told, [g.name for g in found]) for told, found in comparable(groups)] == [
            ("", names),
            ("reduction=mean", names),
            ("", names),
        ]
        # Nothing would be left to compare the settings of one method with.
        sweep = group_records(r for r in (*swingup, *mean) if r.method == "none")
        assert [(told, len(found)) for told, found in comparable(sweep)] == [("", 2)]
        assert [group.name for group in sweep] == ["vanilla", "vanilla, reduction=mean"]

    def test_one_run_in_one_line(self, records):
        """Everything that is kept of it."""
        (record,) = (r for r in records if (r.task, r.method, r.seed) == ("swingup", "caps", 3))
        assert (record.episodes, record.frames, record.updates) == (20, 2000, 200)
        assert (record.policy_scale, record.seconds) == (0.5, 40.0)
        assert (record.torch, record.commit, record.length) == ("2.15.0", "abc", "20 episodes")
        assert record.differences == "task.episodes=20"
        assert (record.late_sampled_return, record.late_mean_return) == (103.0, 115.0)
        assert (record.last_mean_return, record.last_sampled_return) == (123.0, 133.0)

    def test_without_tests_of_late_policies_their_figures_are_unknown(self, tmp_path):
        """But those of the training's own episodes are there."""
        make_run(tmp_path / "a", make_config(), 5.0, 0.1)
        path = tmp_path / "a" / "metrics.csv"
        lines = [row | {"test_return": "nan"} for row in csv.DictReader(path.open())]
        with open(path, "w", newline="") as file:
            writer = csv.DictWriter(file, list(lines[0]))
            writer.writeheader()
            writer.writerows(lines)
        (run,) = read_runs(tmp_path)
        assert math.isnan(run.record.late_mean_return) and run.record.late_sampled_return == 5.0
        late, _ = results_tables(group_records([run.record]))
        assert cells(late, "swingup", "ppo_rpe", "vanilla", "0")[:2] == ["-", "5.00"]

    def test_late_policies_are_those_that_training_tested(self, tmp_path):
        """In its last tenth by frames, which here holds 5 of 20 episodes; not an earlier end's."""
        config = make_config(task="pendulum", algorithm=PPOConfig(), late_share=0.1)
        config = replace(config, task=replace(config.task, frames=1000))
        make_run(tmp_path / "a", config, 5.0, 0.1)
        path = tmp_path / "a" / "metrics.csv"
        lines = list(csv.DictReader(path.open()))
        for number, line in enumerate(lines, 1):
            line["frames"] = 60 * number if number <= 15 else 900 + 20 * (number - 15)
            line["test_return"] = {9: 1e9}.get(number, number - 16 if number > 15 else "nan")
        with open(path, "w", newline="") as file:
            writer = csv.DictWriter(file, list(lines[0]))
            writer.writeheader()
            writer.writerows(lines)
        (run,) = read_runs(tmp_path)
        assert run.record.late_mean_return == 2.0

    def test_a_seed_that_comes_twice_is_told_and_not_pooled(self, tmp_path):
        """The newer one stands."""
        for name, total, time in (("new", 7.0, 2000), ("old", 900.0, 1000)):
            make_run(tmp_path / name, make_config(seed=4), total, 0.1)
            os.utime(tmp_path / name / "evaluation.json", (time, time))
        found = find_runs([tmp_path])
        (run,) = found.runs
        assert run.record.late_sampled_return == 7.0
        (note,) = found.notes
        assert note.startswith("1 the same settings and seed as a newer one, left out")
        assert str(tmp_path / "old") in note

    def test_a_folder_that_is_named_twice_is_read_once(self, tmp_path):
        """Also where one lies within the other."""
        make_run(tmp_path / "a" / "b", make_config(), 1.0, 0.1)
        found = find_runs([tmp_path, tmp_path / "a"])
        assert len(found.runs) == 1 and not found.notes

    def test_runs_of_other_lengths_are_told_and_not_pooled(self, tmp_path):
        """Each is a row of its own, named by its length."""
        for seed, episodes in enumerate((20, 20, 10)):
            make_run(tmp_path / str(seed), make_config(seed=seed, episodes=episodes), 1.0, 0.1)
        groups = group_records(run.record for run in read_runs(tmp_path))
        assert {(group.name, *group.seeds) for group in groups} == {
            ("vanilla, 20 episodes", 0, 1),
            ("vanilla, 10 episodes", 2),
        }
        _, last = results_tables(groups)
        assert any("runs of 10 episodes and of 20 episodes are rows" in note for note in last.notes)

    def test_vanilla_of_as_many_frames_is_compared(self, records):
        """Whatever their numbers of episodes, which are defaults of then and now."""
        vanilla, caps = (next(r for r in records if r.method == name) for name in ("none", "caps"))
        before, frames = "task.episodes=400 ", "task.frames=500"
        vanilla = replace(vanilla, differences=before + frames, length="500 frames")
        caps = replace(caps, differences=frames, length="500 frames")
        baseline, group = group_records([vanilla, caps])
        assert baseline_of(group, [baseline, group]) == baseline

    def test_settings_that_no_name_tells_are_told_below(self, tmp_path):
        """Those of every row, and those of all rows of a method."""
        algorithm = PPORPEConfig(replay_ratio=5)
        for name, method in (("vanilla", "none"), ("ramp", L2C2Config(gain="ramp"))):
            config = make_config(regularizer=method, algorithm=algorithm)
            make_run(tmp_path / name, config, 1.0, 0.1)
        groups = group_records(run.record for run in read_runs(tmp_path))
        assert [group.name for group in groups] == ["vanilla", "L2C2"]
        notes = results_tables(groups)[-1].notes
        assert [note.removeprefix("swingup, ppo_rpe, ") for note in notes[1:]] == [
            "other than the defaults in every row: `algorithm.replay_ratio=5`, `task.episodes=20`.",
            "L2C2, other than the defaults: `regularizer.gain=ramp`.",
        ]

    def test_a_run_can_be_read_as_if_it_had_ended_earlier(self, tmp_path):
        """Its own episodes up to there; what only its end was tested for is unknown."""
        make_run(tmp_path / "run", make_config(), 1.0, 0.1)
        (run,) = read_runs(tmp_path)
        for row, total in zip(run.metrics, range(20), strict=True):
            row["return"] = str(total)
        record = run.until(19).record
        # The last tenth of 19 episodes are two, the 18th and the 19th.
        assert (record.late_sampled_return, record.episodes, record.updates) == (17.5, 19, 190)
        assert (record.length, record.settings) == ("19 episodes", run.record.settings)
        assert math.isnan(record.late_mean_return) and math.isnan(record.last_sampled_return)
        assert run.until(21) is None and run.until(0) is None

    def test_a_run_of_frames_is_cut_by_them(self, tmp_path):
        """Its episodes are as long as they like, and the last one ends beyond what was asked."""
        config = make_config()
        config = replace(config, task=replace(config.task, frames=2000))
        make_run(tmp_path / "run", config, 1.0, 0.1)
        (run,) = read_runs(tmp_path)
        assert run.record.length == "2000 frames"
        assert (run.until(1550).record.length, run.until(1550).record.episodes) == (
            "1550 frames",
            16,
        )

    def test_runs_of_several_versions_are_pooled_and_told(self, records):
        """Their numbers may differ for no other reason."""
        ours = [r for r in records if (r.task, r.method) == ("swingup", "caps")]
        groups = group_records([*ours[:-1], replace(ours[-1], commit="")])
        (group,) = groups
        assert group.seeds == [0, 1, 2, 3, 4]
        _, last = results_tables(groups)
        told = "swingup, ppo_rpe, CAPS: runs of more than one commit (abc, unknown) are pooled."
        assert told in last.notes

    def test_unfinished_and_damaged_folders_are_counted_and_named(self, tmp_path):
        """None is passed over in silence, and none stops the others from being read."""
        make_run(tmp_path / "good", make_config(), 1.0, 0.1)
        make_run(tmp_path / "cut", make_config(seed=1), 1.0, 0.1)
        (tmp_path / "cut" / "evaluation.json").write_text('{"run"')
        make_run(tmp_path / "going", make_config(seed=2), 1.0, 0.1)
        (tmp_path / "going" / "evaluation.json").unlink()
        found = find_runs([tmp_path])
        assert [run.folder.name for run in found.runs] == ["good"]
        for start, name in (
            ("1 unfinished", "going"),
            ("1 unreadable", "cut"),
        ):
            assert sum(n.startswith(start) and str(tmp_path / name) in n for n in found.notes) == 1
        summary = sweep_summary([tmp_path])
        assert "| vanilla | 0 |" in summary and all(note in summary for note in found.notes)

    @pytest.mark.parametrize(
        ("name", "content"),
        [
            ("config.json", b"[]"),
            ("config.json", b"{}"),
            ("config.json", b'{"task": 3, "algorithm": {}, "regularizer": {}}'),
            ("versions.json", b"[]"),
            ("evaluation.json", b"null"),
            ("evaluation.json", b"[1]"),
            ("evaluation.json", b""),
            ("evaluation.json", b'{"summary": {"return_mean": "much"}}'),
            ("evaluation.json", b'{"sampled": 3}'),
            ("evaluation.json", b'{"training": 3}'),
            ("evaluation.json", b'{"training": {"episodes": 21}}'),
            ("metrics.csv", b""),
            ("metrics.csv", b"\xff"),
            ("metrics.csv", b"episode,frames,updates,return\n1,100,10\n"),
        ],
    )
    def test_whatever_a_damaged_file_holds_is_told_with_its_name(self, tmp_path, name, content):
        """Twenty episodes were trained; and another run is read all the same."""
        for seed, folder in enumerate(("good", "bad")):
            make_run(tmp_path / folder, make_config(seed=seed), 1.0, 0.1)
        (tmp_path / "bad" / name).write_bytes(content)
        found = find_runs([tmp_path])
        assert [run.folder.name for run in found.runs] == ["good"]
        named = "metrics.csv" if b"episodes" in content else name
        (note,) = found.notes
        assert note.startswith("1 unreadable: ") and str(tmp_path / "bad" / named) in note

    def test_a_measure_that_could_not_be_taken_is_no_number(self, tmp_path):
        """Of test episodes that are too short, where evaluation.json has null."""
        make_run(tmp_path / "run", make_config(), 1.0, 0.1)
        path = tmp_path / "run" / "evaluation.json"
        content = json.loads(path.read_text())
        content["summary"]["sm_asap_mean"] = None
        path.write_text(json.dumps(content))
        (run,) = read_runs(tmp_path)
        assert math.isnan(run.record.last_mean_sm_asap) and run.record.last_mean_return == 21.0

    def test_names_tell_what_differs_and_only_that(self, tmp_path):
        """What all have in common is a note; what CAPS does not have does not name it."""
        chosen = {"algorithm": PPORPEConfig(replay_ratio=10, critic_weighting="ratio")}
        for name, config in {
            "a": make_config(**chosen),
            "b": make_config(algorithm=PPORPEConfig(replay_ratio=5, critic_weighting="ratio")),
            "c": make_config(regularizer="caps", **chosen),
            "d": make_config(regularizer=L2C2Config(beta=0.0), **chosen),
            "e": make_config(regularizer=L2C2Config(), **chosen),
        }.items():
            make_run(tmp_path / name, config, 1.0, 0.1)
        groups = group_records(run.record for run in read_runs(tmp_path))
        assert {group.name for group in groups} == {
            "vanilla",
            "vanilla, replay_ratio=5",
            "CAPS",
            "L2C2, beta=0",
            "L2C2",
        }
        _, last = results_tables(groups)
        assert any("`algorithm.critic_weighting=ratio`" in note for note in last.notes)


class TestSettings:
    def test_the_commit_is_the_checkouts(self):
        """As git names it; empty where the code lies in none."""
        head = ["git", "rev-parse", "--short=12", "HEAD"]
        found = subprocess.run(head, cwd=ROOT, capture_output=True, text=True, check=False)
        expected = found.stdout.strip() if (ROOT / ".git").exists() else ""
        assert code_commit().removesuffix("-dirty") == expected

    def test_what_changes_no_number_leaves_the_fingerprint(self):
        """Nor do the seed and the length; every other setting changes it."""
        plain = fingerprint(make_config().to_dict())
        free = make_config(seed=9, episodes=7, threads=2, test_episodes=3, late_share=0.5)
        assert fingerprint(free.to_dict()) == plain
        assert fingerprint(make_config(compile=False).to_dict()) != plain
        ratio = make_config(algorithm=PPORPEConfig(replay_ratio=5))
        assert fingerprint(ratio.to_dict()) != plain
        assert fingerprint(make_config(regularizer="caps").to_dict()) != plain

    def test_a_setting_that_is_off_leaves_the_fingerprint(self, monkeypatch):
        """So the codes of older runs stay when it is added."""
        config = make_config().to_dict()
        older = {k: v for k, v in config["task"].items() if v is not None and v is not False}
        newer = {**config["task"], "added": False, "also_added": None}
        codes = []
        for task in (older, newer):
            monkeypatch.setattr(
                ExperimentConfig, "to_dict", lambda _, t=task: {**config, "task": t}
            )
            codes.append(fingerprint(config))
        assert codes[0] == codes[1]

    def test_a_setting_that_is_as_older_runs_had_it_leaves_the_fingerprint(self, monkeypatch):
        """So that runs of before pool with those of now."""
        plain = make_config(regularizer="l2c2").to_dict()
        code = fingerprint(plain)
        monkeypatch.setattr("torchrl_l2c2.experiment.config.NEUTRAL_SETTINGS", {})
        assert fingerprint(plain) != code
        monkeypatch.undo()
        plain["regularizer"]["policy_distance"] = "mean"
        assert fingerprint(plain) != code

    def test_a_run_of_before_a_setting_is_as_that_was_then(self, tmp_path):
        """And not as its default is by now: it is no run of today's, and no two are pooled."""
        today = make_config(episodes=2, test_episodes=2)
        then = make_config(episodes=2, test_episodes=2, algorithm=PPORPEConfig(reduction="mean"))
        for name, config in (("now", today), ("then", then), ("older", today)):
            make_run(tmp_path / name, config, 1.0, 0.1)
        older = tmp_path / "older" / "config.json"
        config = json.loads(older.read_text())
        del config["algorithm"]["reduction"], config["device"]
        older.write_text(json.dumps(config))
        found = {name: FinishedRun.read(tmp_path / name) for name in ("now", "then", "older")}
        told = {name: run.record for name, run in found.items()}
        assert told["older"].settings == told["then"].settings != told["now"].settings
        assert told["older"].differences.split() == ["algorithm.reduction=mean", "task.episodes=2"]
        assert told["now"].differences == "task.episodes=2"
        assert finished_run(tmp_path / "older", then.to_dict()) is not None
        assert finished_run(tmp_path / "older", today.to_dict()) is None

    def test_differences_are_from_the_defaults_of_what_is_chosen_by_name(self):
        """Another replay's own defaults are none; a task of one's own is its id."""
        config = ExperimentConfig.from_dict(
            {
                "task": {"name": "Pendulum-v1", "env_id": "Pendulum-v1", "noise_scale": 0.05},
                "algorithm": {"name": "sac"},
                "regularizer": {"name": "l2c2"},
                "replay": {"name": "prioritized", "alpha": 0.5},
            }
        )
        assert differences(config.to_dict()) == {
            "replay.alpha": "0.5",
            "replay.name": "prioritized",
            "task.noise_scale": "0.05",
        }

    def test_the_papers_numbers_stand_beside_its_own_task_and_algorithm_alone(self, tmp_path):
        """Not beside SAC, another task under its name, or L2C2 with another gain."""
        other = replace(TASKS["swingup"], env_id="Pendulum-v1", episodes=20)
        for name, config in {
            "paper": make_config(),
            "sac": make_config(algorithm=SACConfig(), seed=1),
            "other": replace(make_config(seed=2), task=other),
            "gain": make_config(regularizer=L2C2Config(beta=0.5)),
        }.items():
            make_run(tmp_path / name, config, 1.0, 0.1)
        beside = {run.folder.name: run.record.paper for run in read_runs(tmp_path)}
        assert beside["paper"].return_mean == 649.57
        assert all(beside[name] is None for name in ("sac", "other", "gain"))


class TestStatistics:
    def test_mean_and_deviation_by_hand(self):
        """Of 1, 2, 6: 3, and the root of (4 + 1 + 9) / 2; a single run has no deviation."""
        center, deviation = mean_and_deviation(np.array([[1.0], [2.0], [6.0]]))
        assert (center.item(), deviation.item()) == (3.0, pytest.approx(math.sqrt(7.0)))
        assert math.isnan(mean_and_deviation(np.ones((1, 1)))[1].item())

    def test_the_interquartile_mean_leaves_out_a_quarter_on_either_side(self):
        """Over runs and tasks together: of 0 to 7 it is the mean of 2 to 5; like SciPy's."""
        assert interquartile_mean(np.arange(8.0).reshape(2, 4)).item() == 3.5
        scores = np.random.default_rng(0).normal(size=(18, 3))
        expected = trim_mean(scores, 0.25, axis=None)
        assert interquartile_mean(scores).item() == pytest.approx(expected)

    def test_the_probability_of_improvement_counts_pairs(self):
        """Of 1, 3 over 1, 2: a tie, a loss and two wins; like SciPy's Mann-Whitney statistic."""
        ours, theirs = np.array([[1.0], [3.0]]), np.array([[1.0], [2.0]])
        assert probability_of_improvement(ours, theirs).item() == 2.5 / 4
        generator = np.random.default_rng(0)
        ours, theirs = generator.normal(0.5, size=(7, 2)), generator.normal(size=(5, 2))
        pairs = zip(ours.T, theirs.T, strict=True)
        expected = np.mean([mannwhitneyu(*pair).statistic / 35 for pair in pairs])
        assert probability_of_improvement(ours, theirs).item() == pytest.approx(expected)

    def test_they_give_what_rliables_own_tests_say(self):
        """Its metrics' tests (Agarwal et al. 2021): 1.5, 2 and 1/3 of these scores."""
        ours = np.array([[1.0, 2.0], [2.0, 2.0], [1.0, 1.0], [2.0, 1.0]])
        theirs = np.array([[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]])
        assert interquartile_mean(ours).item() == 1.5
        assert interquartile_mean(theirs).item() == 2.0
        improvement = probability_of_improvement(ours, theirs).item()
        assert improvement == pytest.approx(1 / 3)

    def test_a_task_counts_with_all_of_its_runs(self):
        """However many others have: 1, 3 over 2 win a half, 1 over 0 wins; 3/4 is their mean."""
        ours, theirs = np.array([[1.0, 1.0], [3.0, math.nan]]), np.array([[2.0, 0.0]])
        assert probability_of_improvement(ours, theirs).item() == 0.75
        # Drawn anew, the first task has 0, 1/2 or 1 of them, the second always its one run.
        for confidence, ends in ((0.4, (0.75, 0.75)), (0.95, (0.5, 1.0))):
            generator = np.random.default_rng(0)
            interval = bootstrap_interval(
                probability_of_improvement,
                *(ours, theirs),
                generator=generator,
                confidence=confidence,
            )
            assert interval == ends

    def test_the_bootstrap_of_two_runs_by_hand(self):
        """Means of 0 and 1 drawn anew: 0, 1/2 and 1, with probabilities 1/4, 1/2 and 1/4."""

        def interval(confidence):
            generator = np.random.default_rng(0)
            scores = np.array([[0.0], [1.0]])
            return bootstrap_interval(mean, scores, generator=generator, confidence=confidence)

        assert interval(0.4) == (0.5, 0.5)
        assert interval(0.95) == (0.0, 1.0)

    def test_the_bootstrap_draws_for_every_task_by_itself(self):
        """Then all runs are 0 in 1 of 16; drawn together, in 1 of 4."""
        scores = np.array([[0.0, 0.0], [1.0, 1.0]])
        generator = np.random.default_rng(0)
        interval = bootstrap_interval(mean, scores, generator=generator, confidence=0.8)
        assert interval == (0.25, 0.75)

    def test_the_bootstrap_draws_as_many_runs_as_a_task_has(self):
        """Also where another task has more of them."""

        def runs(scores):
            return (~np.isnan(scores)).sum((-2, -1)).astype(float)

        scores = np.array([[1.0, 5.0], [2.0, np.nan], [3.0, np.nan]])
        assert bootstrap_interval(runs, scores, generator=np.random.default_rng(0)) == (4.0, 4.0)

    def test_the_bootstrap_of_many_pairs_fits_into_memory(self):
        """All resamples of 200 runs beside 200 at once would be 40 million pairs."""
        scores, generator = np.arange(200.0)[:, None], np.random.default_rng(0)
        tracemalloc.start()
        try:
            bootstrap_interval(
                probability_of_improvement, scores, scores, generator=generator, resamples=1000
            )
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        assert peak < 100e6

    def test_the_bootstraps_settings_have_ranges(self):
        """Said with what was given."""
        for name, value in (("confidence", 1.0), ("resamples", 0)):
            with pytest.raises(ValueError, match=f"{name} must be .*got {value}"):
                bootstrap_interval(
                    mean, np.ones((2, 1)), generator=np.random.default_rng(0), **{name: value}
                )

    def test_a_band_is_of_whole_curves(self):
        """Of (0, 1) and (1, 0) the mean of a resample is a run's own or 1/2 everywhere."""
        curves = np.array([[0.0, 1.0], [1.0, 0.0]])
        lower, upper = curve_band(curves, generator=np.random.default_rng(0))
        assert lower.tolist() == [0.0, 0.0] and upper.tolist() == [1.0, 1.0]
        lower, upper = curve_band(curves, generator=np.random.default_rng(0), confidence=0.4)
        assert lower.tolist() == upper.tolist() == [0.5, 0.5]

    def test_the_tables_of_statistics_by_hand(self, records):
        """Interquartile means of 0 to 4 are those of 1 to 3; 100 more always beats vanilla."""
        tables = statistics_tables(group_records(records))
        assert [table.title for table in tables] == [f"Statistics: {t}" for t in TESTS.values()]
        row = cells(tables[1], "swingup", "ppo_rpe", "CAPS", "5")
        assert row[0].startswith("102.0 [") and row[1] == "1.00 [1.00, 1.00]"
        # Of .09 to .094 against .1 to .104 every pair is smoother.
        assert row[2].startswith("0.092 [") and row[3] == "1.00 [1.00, 1.00]"
        assert cells(tables[1], "swingup", "ppo_rpe", "vanilla", "5")[1::2] == ["", ""]
        across = cells(tables[1], "2 tasks", "ppo_rpe", "CAPS", "5")
        assert across == ["", "1.00 [1.00, 1.00]", "", "1.00 [1.00, 1.00]"]

    def test_runs_that_have_the_figure_are_counted_by_task(self, records):
        """No seed needs to be on every task; of a run without the figure there is nothing."""
        caps = [r for r in records if r.method == "caps"]
        swingup, reacher = ([r for r in caps if r.task == t] for t in ("swingup", "reacher"))
        # Four runs that return less than all of vanilla's, and one that was not tested.
        lost = [replace(r, last_mean_return=-9.0) for r in swingup[1:]]
        untested = replace(swingup[0], last_mean_return=math.nan)
        others = [replace(r, seed=100 + r.seed) for r in reacher[:3]]
        vanilla = [r for r in records if r.method == "none"]
        groups = group_records([untested, *lost, *others, *vanilla])
        tables = {table.title: table for table in statistics_tables(groups)}
        table = tables["Statistics: last policy, mean actions"]
        assert cells(table, "swingup", "ppo_rpe", "CAPS")[0] == "4"
        # None of 20 pairs and all of 15, of seeds that the tasks do not share.
        across = cells(table, "2 tasks", "ppo_rpe", "CAPS")
        assert across[:3] == ["3, 4", "", "0.50 [0.50, 0.50]"]
        without = [untested, *others, *vanilla]
        (table,) = (
            t for t in statistics_tables(group_records(without)) if "last policy, mean" in t.title
        )
        assert cells(table, "swingup", "ppo_rpe", "CAPS")[:3] == ["0", "-", ""]
        assert not [row for row in table.rows if row[0] == "2 tasks"]

    def test_a_row_over_tasks_does_not_depend_on_what_else_a_task_has(self, records):
        """Other lengths of one task, of vanilla or of the method, add rows and take none."""

        def across(found):
            table = statistics_tables(group_records(found))[0]
            return [list(row[1:]) for row in table.rows if row[0].endswith(" tasks")]

        before = across(records)
        assert [row[1] for row in before] == ["CAPS", "L2C2", "L2C2, beta=0.5"]
        swingup = [r for r in records if r.task == "swingup"]
        longer = {
            method: [replace(r, length="30 episodes") for r in swingup if r.method == method]
            for method in ("none", "caps")
        }
        assert across([*records, *longer["none"]]) == before
        (caps, *others), told = before, "CAPS, 20 episodes"
        assert across([*records, *longer["none"], *longer["caps"]]) == [
            [caps[0], told, *caps[2:]],
            *others,
        ]
        # Other defaults, when they were run: which are those of the other task is not known.
        older = [replace(r, settings="older") for r in swingup if r.method == "caps"]
        assert across([*records, *older]) == others

    def test_other_settings_of_a_method_are_another_row(self, records):
        """Also where every task has but one of them, and so no name tells them."""
        vanilla, l2c2 = ([r for r in records if r.method == name] for name in ("none", "l2c2"))
        apart = [
            *(
                r
                for r in l2c2
                if r.task == "swingup" and "regularizer.beta" not in r.other_settings
            ),
            *(r for r in l2c2 if r.task == "reacher" and "regularizer.beta" in r.other_settings),
        ]
        groups = group_records([*vanilla, *apart])
        assert [group.name for group in groups] == ["vanilla", "L2C2"] * 2
        rows = over_tasks(group for group in groups if group.first.method != "none")
        assert [(name, [g.first.task for g in row]) for _, name, row in rows] == [
            ("L2C2", ["swingup"]),
            ("L2C2, beta=0.5", ["reacher"]),
        ]
        assert all(row[0] != "2 tasks" for row in statistics_tables(groups)[0].rows)


class TestScore:
    def test_the_score_is_the_protocols_by_hand(self, tmp_path):
        """Distances in the paper's deviations, at most 5, of vanilla and CAPS alone."""
        # The mean over seeds lies 77.96 above the paper's: one deviation. Smoother by 2 of .011.
        for seed, more in enumerate((67.96, 87.96)):
            make_run(tmp_path / f"none{seed}", make_config(seed=seed), 649.57 + more, 0.084 - 0.022)
        # 3 deviations of 26.56 below, and 100 of .002 too rough, which count as 5.
        make_run(tmp_path / "caps", make_config(regularizer="caps"), 239.57 - 79.68, 0.226)
        make_run(tmp_path / "l2c2", make_config(regularizer="l2c2"), -1e9, 9.0)
        found = read_runs(tmp_path)
        (reading,) = readings(group_records(run.record for run in found))
        assert reading.score("late_sampled") == pytest.approx((1 + 2 + 3 + 5) / 4)
        # With mean actions, returns are 12 higher and variations .012.
        distances = (1 + 12 / 77.96, 2 - 0.012 / 0.011, 3 - 12 / 26.56, 5)
        assert reading.score("late_mean") == pytest.approx(sum(distances) / 4, abs=1e-5)

    def test_only_equal_settings_are_one_reading(self, tmp_path):
        """Vanilla of one and CAPS of another give no score."""
        make_run(tmp_path / "a", make_config(), 1.0, 0.1)
        other = make_config(regularizer="caps", algorithm=PPORPEConfig(replay_ratio=5))
        make_run(tmp_path / "b", other, 1.0, 0.1)
        assert not readings(group_records(run.record for run in read_runs(tmp_path)))


class TestRecords:
    def test_the_file_gives_the_same_tables_as_the_folders(self, records, tmp_path):
        """To the character, with sorted lines that do not depend on the order they came in."""
        write_records(tmp_path / "a.csv", records)
        write_records(tmp_path / "b.csv", reversed(records))
        assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()
        groups = [group_records(r) for r in (records, read_records(tmp_path / "a.csv"))]
        for make in (results_tables, statistics_tables):
            ours, theirs = ([table.markdown() for table in make(g)] for g in groups)
            assert ours == theirs

    def test_a_run_is_replaced_by_its_newer_self(self, records):
        """Others stay as they are."""
        newer = replace(records[7], late_mean_return=-1.0)
        merged = merge(records, [newer])
        assert len(merged) == len(records)
        assert [a for a, b in zip(merged, records, strict=True) if a != b] == [newer]

    def test_an_unknown_number_is_an_empty_cell(self, records, tmp_path):
        """And comes back as unknown."""
        write_records(tmp_path / "runs.csv", [replace(records[0], policy_scale=math.nan)])
        (back,) = read_records(tmp_path / "runs.csv")
        assert math.isnan(back.policy_scale) and back.seconds == records[0].seconds

    def test_a_file_of_something_else_is_refused(self, records, tmp_path):
        """With its name, and the line where there is one."""
        path = tmp_path / "runs.csv"
        path.write_text("a,b\n1,2\n")
        with pytest.raises(ValueError, match=r"runs\.csv has the columns"):
            read_records(path)
        write_records(path, records[:1])
        path.write_text(path.read_text().replace(",2000,", ",many,"))
        with pytest.raises(ValueError, match=r"runs\.csv, line 2: .*many"):
            read_records(path)
        write_records(path, records[:2])
        whole = path.read_text()
        for cut in (whole.rpartition(",")[0] + "\n", whole.rstrip("\n") + ",more\n"):
            path.write_text(cut)
            with pytest.raises(ValueError, match=r"runs\.csv, line 3: 2[35] cells, .* has 24"):
                read_records(path)
        path.write_text(whole.rstrip("\n") + " algorithm.repl\n")
        with pytest.raises(ValueError, match=r"runs\.csv, line 3: .* got 'algorithm.repl'"):
            read_records(path)


class TestPictures:
    def test_the_same_runs_give_the_same_bytes_without_a_date(self, forty, records, tmp_path):
        """So that a picture in a repository changes only with its numbers."""
        runs = [run for run in read_runs(forty) if run.task == "swingup"]
        for name in ("a.svg", "b.svg"):
            draw_learning_curves(runs, tmp_path / f"curves_{name}")
            draw_plane(group_records(records[:20]), "late_mean", tmp_path / f"plane_{name}")
        for kind in ("curves", "plane"):
            first, second = ((tmp_path / f"{kind}_{n}.svg").read_text() for n in "ab")
            assert first == second and "<dc:date>" not in first
            assert all(name in first for name in METHODS)

    @pytest.mark.filterwarnings("error:constrained_layout not applied")
    def test_a_long_legend_leaves_room_for_the_axes(self, records, tmp_path):
        """Of many settings with long names; it was a warning, and an empty picture."""
        (group, *_) = group_records(records)
        many = [replace(group, name=f"L2C2, gain_target={i}, " + "long " * 8) for i in range(20)]
        draw_plane(many, "late_mean", tmp_path / "plane.svg")

    def test_a_tasks_name_is_no_formula(self, records, tmp_path):
        """Of one's own; dollars in it were read as LaTeX's, which it is not."""
        own = [replace(record, task="$^$") for record in records if record.task == "swingup"]
        draw_plane(group_records(own), "late_mean", tmp_path / "plane.svg")
        config = make_config()
        make_run(tmp_path / "run", replace(config, task=replace(config.task, name="$^$")), 1.0, 0.1)
        draw_learning_curves(read_runs(tmp_path / "run"), tmp_path / "curves.svg")
        for picture in ("plane.svg", "curves.svg"):
            assert "$^$" in (tmp_path / picture).read_text()

    def test_a_single_run_is_drawn_as_png(self, forty, tmp_path):
        """As every run's folder has it."""
        draw_learning_curves(read_runs(forty)[:1], tmp_path / "curves.png")
        assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")


class TestReport:
    def test_the_page_needs_nothing_else(self, forty, tmp_path):
        """Every picture is within it, every table, and no address."""
        found = find_runs([forty])
        page = write_report(tmp_path, [run.record for run in found.runs], found.runs)
        text = page.read_text()
        pictures = sorted(path.stem for path in tmp_path.glob("*.svg"))
        assert pictures == [
            "learning_curves_reacher_ppo_rpe",
            "learning_curves_swingup_ppo_rpe",
            *sorted(f"plane_{test}" for test in TESTS),
        ]
        assert text.count('src="data:image/svg+xml;base64,') == len(pictures)
        assert not re.search(r'(?:src|href)="(?!data:)', text) and "http" not in text
        markdown = (tmp_path / "report.md").read_text()
        for title in ("Late policies", "Last policy", "Score of the readings", "Every run"):
            assert f"<h2>{title}</h2>" in text and f"**{title}**" in markdown
        groups = json.loads((tmp_path / "report.json").read_text())["groups"]
        assert groups[2]["statistics"]["late_sampled_return"]["mean"] == 202.0
        assert groups[2]["paper"]["return_mean"] == 693.77

    def test_sm_is_among_the_plain_numbers_where_it_was_measured(self, records):
        """That of the last policy's mean actions, as in the field's tables."""
        rough = [replace(r, last_mean_sm_asap=float(r.seed)) for r in records]
        for group in summary(group_records(rough)):
            assert group["statistics"]["last_mean_sm_asap"]["mean"] == 2.0
        assert "last_mean_sm_asap" not in summary(group_records(records))[0]["statistics"]

    def test_the_command_prints_the_same_from_folders_and_from_their_records(
        self, forty, tmp_path, capsys
    ):
        """And no report, unless it is asked for."""
        file = str(tmp_path / "runs.csv")
        main([str(forty), "--csv", file])
        tables, _, _ = capsys.readouterr().out.partition("\n\nrecords: ")
        assert tables.count("\n| ") == 33
        main(["--from", file])
        assert capsys.readouterr().out.strip() == tables
        main(["--from", file, "--score"])
        assert capsys.readouterr().out.count("| reacher | the defaults | 20 episodes | 0-4 |") == 2
        assert not (forty / "report").exists()
        parts = [str(tmp_path / f"{task}.csv") for task in ("swingup", "reacher")]
        for part in parts:
            main([str(forty / Path(part).stem), "--csv", part])
        capsys.readouterr()
        main(["--from", *parts])
        assert capsys.readouterr().out.strip() == tables

    def test_the_report_lies_in_the_runs_folder(self, tmp_path, capsys):
        """Where no other is named; the same command reads past it."""
        make_run(tmp_path / "run", make_config(), 1.0, 0.1)
        main([str(tmp_path)])
        assert str(tmp_path / "report" / "report.html") in capsys.readouterr().out
        assert (tmp_path / "report" / "report.html").exists()
        assert len(read_runs(tmp_path)) == 1

    def test_lengths_are_rows_beside_vanilla_of_the_same_length(self, forty, tmp_path, capsys):
        """And a score each; without tables of what nobody tested."""
        swingup = str(forty / "swingup")
        main([swingup, "--length", "20", "10", "--score"])
        scores = [line.split(" | ") for line in capsys.readouterr().out.splitlines()]
        # Those that were trained for 20 have all of their figures.
        assert [(row[2], row[5]) for row in scores if row[0] == "| swingup"] == [
            ("10 episodes", "sampled actions"),
            ("20 episodes", "mean actions"),
            ("20 episodes", "sampled actions"),
        ]
        main([swingup, "--length", "10", "30", "--output", str(tmp_path)])
        printed = capsys.readouterr().out
        assert "Last policy" not in printed and printed.count("| swingup |") == 8
        assert "20 runs are not as long as a length that was asked for" in printed
        report = (tmp_path / "report.md").read_text()
        assert report.count("**Statistics") == 1 and "0.50 [0.50, 0.50]" in report

    def test_what_goes_by_the_length_is_told_of_runs_that_were_cut(self, tmp_path, capsys):
        """They are not what a shorter training would have been; whole ones are."""
        ramped = make_config(regularizer="l2c2_ramp", optimizer=AdamConfig(linear=True))
        make_run(tmp_path / "run", ramped, 1.0, 0.1)
        main([str(tmp_path), "--length", "10"])
        printed = capsys.readouterr().out
        for setting in ("optimizer.linear=true", "regularizer.gain=ramp"):
            assert f"1 runs, cut to a length, have {setting} as in their own, longer" in printed
        main([str(tmp_path), "--length", "20"])
        assert "as in their own" not in capsys.readouterr().out

    def test_a_run_of_a_length_stands_for_its_seed_before_one_that_was_cut_to_it(
        self, tmp_path, capsys
    ):
        """Its last policy was tested, which no record without such tests takes the place of."""
        for episodes in (20, 10):
            config = make_config(episodes=episodes)
            make_run(tmp_path / str(episodes), config, float(episodes), 0.1)
        short, long, file = (str(tmp_path / name) for name in ("10", "20", "runs.csv"))
        for folders in ([short, long], [short], [long]):
            main([*folders, "--length", "10", "--csv", file])
            (record,) = read_records(file)
            assert (record.length, record.late_sampled_return) == ("10 episodes", 9.0)
            assert (record.last_mean_return, record.last_sampled_return) == (30.0, 40.0)
        printed = capsys.readouterr().out
        assert printed.count("1 runs, cut to a length, have the settings, seed and length") == 1
        main([long, "--length", "10", "--csv", str(tmp_path / "cut.csv")])
        (cut,) = read_records(tmp_path / "cut.csv")
        assert math.isnan(cut.last_mean_return)
        (whole,) = merge([cut], [record])
        assert whole.last_mean_return == 30.0

    def test_what_cannot_be_done_is_one_line(self, tmp_path, capsys):
        """An empty folder, no folder, a file that is not there."""
        with pytest.raises(SystemExit, match="error: no finished run"):
            main([str(tmp_path)])
        with pytest.raises(SystemExit, match=r"error: there is no file"):
            main(["--from", str(tmp_path / "runs.csv")])
        write_records(tmp_path / "none.csv", [])
        with pytest.raises(SystemExit, match=r"error: no record of a run in '.*none\.csv'"):
            main(["--from", str(tmp_path / "none.csv"), "--output", str(tmp_path / "rep")])
        make_run(tmp_path / "run", make_config(), 1.0, 0.1)
        with pytest.raises(SystemExit, match="error: no run is as long as 30 episodes"):
            main([str(tmp_path), "--length", "30"])
        with pytest.raises(SystemExit):
            main([str(tmp_path), "--length", "0"])
        assert "--length must be at least 1, got 0" in capsys.readouterr().err
        with pytest.raises(SystemExit):
            main([])
        assert "name folders of runs" in capsys.readouterr().err


# PPO's one setting of L2C2 and what it is compared with, by their names in tables.
OURS = "L2C2, mse 1, ramp"
WEAK_CAPS = "CAPS, lambda_spatial=0.005"
RIVALS = ("vanilla", "CAPS", WEAK_CAPS, "CATS")


@pytest.mark.parametrize("name", ["field", "hopper", "sac_lunarlander", "sac_pendulum", "walker2d"])
def test_the_fields_pages_are_those_of_their_records(name):
    """As the command writes them that stands at the top of each."""
    page = ROOT / "results" / f"{name}.md"
    records, text = read_records(page.with_suffix(".csv")), page.read_text()
    first = f"{against_table(records, OURS).markdown()}\n\n" if name == "hopper" else ""
    assert fill(text, first + field_results(records).text(f"{name}.svg")) == text
    shown = [record for group in field_groups(records) for record in group.records]
    assert f"records {digest(shown)}<" in page.with_suffix(".svg").read_text()


def one_setting():
    """The records of PPO's one setting, and of its rivals: its three tasks, and Hopper."""
    named = ("field", "walker2d", "hopper")
    records = [r for name in named for r in read_records(ROOT / "results" / f"{name}.csv")]
    groups = [group for group in group_records(records) if group.name in (OURS, *RIVALS)]
    return [record for group in groups for record in group.records]


def test_the_page_of_one_setting_is_that_of_its_records():
    """As its last command writes it, with what L2C2 is against each rival."""
    page = ROOT / "results" / "one_setting.md"
    text, records = page.read_text(), one_setting()
    first = against_table(records, OURS).markdown()
    assert fill(text, f"{first}\n\n{field_results(records).text('one_setting.svg')}") == text


def by_methods(table):
    """The cells of a table of methods by methods."""
    return {row[0]: dict(zip(table.columns, row, strict=True)) for row in table.rows}


def test_what_is_said_of_the_rivals_is_of_the_records():
    """How probable a smoother run, and one that returns more, is over the four tasks."""
    more, smoother = map(by_methods, pairwise_tables(one_setting()))
    for page in ((ROOT / name).read_text() for name in ("README.md", "results/one_setting.md")):
        said = " ".join(page.partition("a run with L2C2 has a smaller Sm")[2].split())
        start = said.partition(". ")[0]
        for table in (more, smoother):
            assert table[OURS]["CATS"] in start and table[OURS]["CAPS"] in start
        assert smoother[OURS][WEAK_CAPS] in said and more[WEAK_CAPS][OURS] in said


def test_what_each_part_of_the_setting_does_is_of_the_records():
    """Beside vanilla, the paper's and PPO's one setting on the same seeds."""
    parts, field = (read_records(ROOT / "results" / f"{name}.csv") for name in ("parts", "field"))
    beside = [
        r for r in field if r.method in ("none", "l2c2_paper") or r.commit.startswith("e01476b")
    ]
    seeds = {record.seed for record in parts}
    table = field_table([*parts, *(record for record in beside if record.seed in seeds)])
    rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    shown = [row for row in rows if row["seeds"]]
    page = (ROOT / "results" / "parts.md").read_text().partition("## How large")[0]
    lines = [line.split(" | ") for line in page.splitlines() if line.startswith("| ")][2:]
    found = {(task.removeprefix("| "), " | ".join(cells)) for task, _, *cells in lines}
    columns = ("seeds", "return", "Sm", "action variation", *BETTER.values())
    expected = {
        (row["task"], f"{' | '.join(row[column] for column in columns)} |") for row in shown
    }
    assert len(shown) == len(lines) == 18 and found == expected


def test_what_is_said_of_both_lengths_of_sac_is_of_the_records():
    """Seed by seed, and in the mean."""
    page = (ROOT / "results" / "sac_pendulum.md").read_text()
    for frames, name in (("30,000", "sac_pendulum"), ("100,000", "sac_pendulum_100000")):
        records = read_records(ROOT / "results" / f"{name}.csv")
        runs = {r.seed: r for r in records if r.method == "none" and r.seed < 5}
        pairs = np.array([(runs[s].last_mean_return, runs[s].last_mean_sm_asap) for s in range(5)])
        cells = [f"{total:.0f} / {sm:.3f}" for total, sm in pairs]
        mean = "{:.1f} / {:.3f}".format(*pairs.mean(0))
        assert f"| {' | '.join([frames, *cells, mean])} |" in page


def test_cats_as_strong_as_l2c2_is_of_the_records():
    """Both at the same strength, on two tasks: means, and how probable a better run is."""
    page = (ROOT / "results" / "one_setting.md").read_text().partition("## CATS, as strong")[2]
    groups = group_records(read_records(ROOT / "results" / "field.csv"))
    for task, gain in (("pendulum", 0.5), ("lunarlander", 0.25)):
        named = {group.name: group for group in groups if group.first.task == task}
        ours, cats = named[OURS], named[f"CATS, lambda_temporal={gain}"]
        for group in (ours, cats):
            total, sm, variation = (
                group.scores("last_mean", quantity).mean().item()
                for quantity in ("return", "sm_asap", "action_variation")
            )
            assert (
                f"| {task} | {group.name} | 0-9 | {total:.1f} | {sm:.3f} | {variation:.3f} |"
                in page
            )
        for quantity in ("return", "sm_asap"):
            better = improvement([ours], [cats], "last_mean", quantity).text("{:.2f}".format)
            assert better.replace("0.", ".") in page


@pytest.mark.parametrize(
    "name", ["field", "walker2d", "hopper", "sac_pendulum", "sac_pendulum_100000"]
)
def test_what_is_said_of_the_harness_is_of_the_records(name):
    """Vanilla's and the rivals' rows beside the published ones."""
    table = field_table(read_records(ROOT / "results" / f"{name}.csv"))
    rows = [dict(zip(table.columns, row, strict=True)) for row in table.rows]
    shown = [row for row in rows if row["seeds"] and not row["method"].startswith("L2C2")]
    columns = (*table.columns[:5], "published: return", "Sm", "published: Sm")
    page = (ROOT / "docs" / "field.md").read_text()
    gains = Counter((row["task"], row["method"].partition(",")[0]) for row in shown)
    for row in shown:
        method, _, gain = row["method"].partition(",")
        method += f",{gain}" if gain and gains[row["task"], method] > 1 else ""
        method += ", 100000 frames" if name.endswith("100000") else ""
        cells = [row[column] for column in columns]
        assert f"| {' | '.join([*cells[:2], method, *cells[3:]])} |" in page


@pytest.mark.parametrize("name", ["field_gains", "one_gain", "caps_gains"])
def test_tables_of_gains_are_those_of_their_records(name):
    """The rivals', those of one gain for three tasks, and CAPS's by the same rule."""
    records = read_records(ROOT / "results" / f"{name}.csv")
    if name == "caps_gains":  # Beside the vanilla of the same seeds.
        others = read_records(ROOT / "results" / "one_gain.csv")
        records += [r for r in others if r.method == "none" and r.task != "walker2d_v5"]
    assert choice_table(records).markdown() in (ROOT / "results" / "field_gains.md").read_text()


def test_the_gains_of_sac_are_those_of_their_records():
    """Every run of the seeds that gains are chosen on is a cell; of the others the means are."""
    page = (ROOT / "results" / "field_gains.md").read_text()

    def cell(*records):
        means = (
            statistics.fmean(getattr(r, f"last_mean_{name}") for r in records)
            for name in ("return", "sm_asap")
        )
        return "{:.1f} / {:.3f}".format(*means).replace("/ 0.", "/ .")

    gains = read_records(ROOT / "results" / "sac_gains.csv")
    assert all(cell(record) in page for record in gains if record.seed >= 100)
    shown = [r for r in gains if r.seed < 100 and r.differences.count("lambda_") > 1]
    shown += read_records(ROOT / "results" / "sac_pendulum.csv")
    for group in group_records(shown):
        assert cell(*group.records[:4]) in page, group.name


def test_walkings_gains_are_those_of_their_records():
    """Every run of the seeds that its gains are chosen on is a cell."""
    page = (ROOT / "results" / "field_gains.md").read_text()
    records = read_records(ROOT / "results" / "walker2d_gains.csv")
    records += [
        r for r in read_records(ROOT / "results" / "one_gain.csv") if r.task == "walker2d_v5"
    ]
    for record in records:
        cell = f"{record.last_mean_return:.0f} / {record.last_mean_sm_asap:.3f}"
        assert f"| {cell.replace('/ 0.', '/ .')} |" in page
    assert len(records) >= 24


def reacher_by_seed():
    """A row a seed: return and action variation of the late policies with sampled actions."""
    records = read_records(ROOT / "results" / "runs.csv")
    groups = shown_groups([record for record in records if record.task == "reacher"])
    groups = [group for group in groups if group.first.method != "caps"]
    rows = [["seed", *(group.name for group in groups)], ["---"] * (1 + len(groups))]
    for together in zip(*(group.records for group in groups), strict=True):
        cells = (
            f"{r.late_sampled_return:.1f} / {r.late_sampled_action_variation:.3f}" for r in together
        )
        rows.append([str(together[0].seed), *cells])
    return "\n".join(f"  | {' | '.join(row)} |" for row in rows)


def test_what_reachers_seeds_did_is_of_the_records():
    """Every seed's return and action variation, as the protocol's page tells them."""
    assert reacher_by_seed() in (ROOT / "docs" / "protocol.md").read_text()


def test_the_pages_of_other_readings_are_those_of_their_records():
    """The table before the loss was summed over the batch; Reacher's of the other length."""
    records = read_records(ROOT / "results" / "runs.csv")
    mean = [r for r in records if r.other_settings.get("algorithm.reduction") == "mean"]
    rest = [record for record in records if record not in mean]
    short = [r for r in rest if (r.task, r.length) == ("reacher", "3000 episodes")]
    for name, shown in (("batch_mean", mean), ("reacher_3000", short)):
        page = (ROOT / "results" / f"{name}.md").read_text()
        assert paper_table(group_records(shown)).markdown() in page


def test_the_targets_are_those_of_their_records():
    """As the command at the top of the page prints them."""
    page = (ROOT / "results" / "targets.md").read_text()
    files = re.search("--from (.*)", page)[1].split()
    records = merge([], [record for file in files for record in read_records(ROOT / file)])
    table = gain_targets_table(records)
    assert table.markdown() in page
    asked = [row for row in table.rows if row[4]]
    assert len(asked) >= 16
    for task in ("swingup", "hopper"):
        tried = read_records(ROOT / "results" / f"{task}_targets.csv")
        assert gain_targets_table(tried).markdown().split("\n\n")[1] in page


# Rows of the README's first table: whose records, of which method, as tables call it, and length.
HEADLINE = {
    "SAC, Pendulum": ("sac_pendulum", "L2C2, means 10", "30000 frames"),
    "PPO, LunarLander": ("field", "L2C2, mse 1, ramp", "500000 frames"),
    "PPO, Pendulum": ("field", "L2C2, mse 1, ramp", "500000 frames"),
    "PPO, Hopper": ("hopper", "L2C2, mse 1, ramp", "1000000 frames"),
    "PPO, Walker2d": ("walker2d", "L2C2, mse 1, ramp", "1000000 frames"),
    "PPO-RPE, Reacher, as in the paper": ("runs", "L2C2", "4500 episodes"),
    "PPO-RPE, Swingup, as in the paper": ("runs", "L2C2", "350 episodes"),
    "PPO-RPE, Swingup, with a target": ("runs", "L2C2, means, target 0.045", "350 episodes"),
}
MEASURED = {"sm_asap": "Sm", "action_variation": "action variation"}


def headline_groups(label):
    """L2C2 and vanilla on the same seeds."""
    name, method, length = HEADLINE[label]
    named = label.split(", ")[1].lower()
    task = f"{named}_v5" if named in ("hopper", "walker2d") else named
    read = read_records(ROOT / "results" / f"{name}.csv")
    read = [r for r in read if (r.task, r.length) == (task, length) and TAU not in r.other_settings]
    (ours,) = (group for group in group_records(read) if group.name == method)
    beside = [r for r in read if r.method == "none" and r.seed in ours.seeds]
    (plain,) = group_records(beside)
    assert plain.seeds == ours.seeds == [*range(len(ours.seeds))] and plain.reading == ours.reading
    return ours, plain


def headline(label):
    """Rows of vanilla and of L2C2: means, and how probable an improvement is."""
    ours, plain = headline_groups(label)
    name, test = HEADLINE[label][0], "last_mean"

    def compared(quantity, digits, *, changes=False):
        means = [plain.scores(test, quantity).mean(), ours.scores(test, quantity).mean()]
        cells = [f"{value:.{digits if abs(value) >= 100 or digits else 1}f}" for value in means]
        cells += [f"{means[1] / means[0] - 1:+.0%}"] if changes else []
        return [*cells, improvement([ours], [plain], test, quantity).text("{:.2f}".format)]

    rows, of_return = [], compared("return", 0)
    start = [label, number_range(plain.seeds)]
    # The paper measures the action variation alone.
    for measure in ("action_variation",) if name == "runs" else MEASURED:
        cells = [*start, MEASURED[measure], *compared(measure, 3, changes=True), *of_return]
        rows.append(f"| {' | '.join(cells)} |")
        start, of_return = ["", ""], ["", "", ""]
    return "\n".join(rows)


class TestReadme:
    @pytest.mark.parametrize("label", HEADLINE)
    def test_its_first_table_is_of_the_records(self, label):
        """Of all seeds of vanilla and of L2C2: roughness, and the return."""
        assert headline(label) in (ROOT / "README.md").read_text()

    def test_returns_seed_by_seed_are_of_the_records(self):
        """How often L2C2's is the lower one, which pairs of all seeds tell less of."""
        told = {"PPO's Pendulum": "PPO, Pendulum", "SAC": "SAC, Pendulum"}
        told |= {task: f"PPO, {task}" for task in ("LunarLander", "Hopper", "Walker2d")}
        readme = (ROOT / "README.md").read_text()
        for name, label in told.items():
            ours, plain = (
                {r.seed: r.last_mean_return for r in group.records}
                for group in headline_groups(label)
            )
            lower = sum(ours[seed] < plain[seed] for seed in ours)
            assert f"{lower} of {len(ours)} ({name})" in readme

    def test_its_results_are_those_of_the_records(self):
        """And those of the page of all of them, as the command at its top writes both."""
        recorded = read_records(ROOT / "results" / "runs.csv")
        results, readme = paper_results(recorded), (ROOT / "README.md").read_text()
        assert fill(readme, results.table, START_TABLE) == readme
        page = ROOT / "results" / "paper.md"
        assert fill(page.read_text(), results.text("paper.svg")) == page.read_text()
        shown = [r for group in shown_groups(recorded) for r in group.records]
        assert f"records {digest(shown)}<" in page.with_suffix(".svg").read_text()

    def test_the_command_fills_it_in(self, records, tmp_path):
        """Between the marks, whatever stood there; details and picture where the mark says so."""
        readme, page = tmp_path / "README.md", tmp_path / "paper.md"
        file = tmp_path / "runs.csv"
        readme.write_text(f"before\n{START_TABLE}\nold\n{END}\nafter\n")
        page.write_text(f"before\n{START}\nold\n{END}\nafter\n")
        write_records(file, records)
        main(["--from", str(file), "--page", str(readme), str(page)])
        texts = [readme.read_text(), page.read_text()]
        for text in texts:
            assert text.startswith("before\n") and text.endswith("after\n") and "old" not in text
            assert "| swingup | L2C2 | 0-4 | 202.0 (1.6)† | 693.8 (123.8) | 232.0 (1.6) |" in text
        assert ["interquartile" in text for text in texts] == [False, True]
        assert ["](paper.svg)" in text for text in texts] == [False, True]
        assert [each.name for each in tmp_path.glob("*.svg")] == ["paper.svg"]
        # Where a task has runs as long as it is trained by default, they stand for it.
        usual = replace(records[0], length=f"{TASKS['swingup'].episodes} episodes")
        write_records(file, [*records, usual])
        main(["--from", str(file), "--page", str(readme)])
        told = [line for line in readme.read_text().splitlines() if line.startswith("| swingup")]
        methods = {tuple(line.replace("ppo_rpe | ", "").split(" | ")[1:2]) for line in told}
        assert methods == {("vanilla",)} and "| swingup | vanilla | 0 |" in told[0]
        assert "| reacher | L2C2 | 0-4 |" in readme.read_text()

    def test_of_the_fields_tasks_it_fills_in_theirs(self, tmp_path):
        """With a picture of the page's own name beside it."""
        page, file = tmp_path / "ours.md", tmp_path / "runs.csv"
        page.write_text(f"before\n{START}\nold\n{END}\nafter\n")
        for method, total in (("none", -150.0), ("cats", -140.0)):
            config = make_config(task="pendulum", algorithm=PPOConfig(), regularizer=method)
            make_run(tmp_path / method, config, total, 0.1)
        main([str(tmp_path), "--csv", str(file), "--page", str(page)])
        text = page.read_text()
        assert text.startswith("before\n") and text.endswith("after\n") and "old" not in text
        assert "](ours.svg)" in text and (tmp_path / "ours.svg").exists()
        assert "| pendulum | ppo | CATS | 0 | -120.0 |" in text and "| -184 | 0.343 |" in text

    def test_results_are_not_lost_for_those_of_other_tasks(self, records, tmp_path):
        """Nothing is written then; what a file of records had before counts too."""
        readme, file, given = tmp_path / "README.md", tmp_path / "runs.csv", tmp_path / "given.csv"
        before = f"{START}\nold\n{END}\n"
        readme.write_text(before)
        for none, told in (
            ([], "no record of a run in"),
            (
                [replace(records[0], task="cartpole", algorithm="dqn")],
                "none of 1 records is of the paper.s .* by --from or --csv",
            ),
        ):
            write_records(given, none)
            with pytest.raises(SystemExit, match=told):
                main(["--from", str(given), "--page", str(readme)])
        make_run(tmp_path / "run", make_config(task="pendulum", algorithm=TD3Config()), 1.0, 0.1)
        command = [str(tmp_path / "run"), "--csv", str(file), "--page", str(readme)]
        with pytest.raises(SystemExit, match="error: none of 1 records"):
            main(command)
        assert readme.read_text() == before and not file.exists()
        assert not [*tmp_path.glob("*.svg")]
        # Nor where another page has no marks.
        other = tmp_path / "other.md"
        other.write_text("no marks")
        write_records(given, records)
        with pytest.raises(SystemExit, match="error: the text must have"):
            main(["--from", str(given), "--page", str(readme), str(other)])
        assert readme.read_text() == before
        write_records(file, records)
        main(command)
        assert "| swingup | L2C2 | 0-4 |" in readme.read_text()
        assert len(read_records(file)) == len(records) + 1

    def test_a_text_without_the_marks_is_refused(self):
        """Rather than changed somewhere."""
        with pytest.raises(ValueError, match="once each"):
            fill(f"{END} and {START}", "results")
        with pytest.raises(ValueError, match=r"must have .* of the table alone"):
            fill(f"{START_TABLE} and nothing else", "results", START_TABLE)

    def test_a_file_that_is_not_there_is_told(self, records, tmp_path):
        """With what it would need."""
        write_records(tmp_path / "runs.csv", records)
        with pytest.raises(SystemExit, match=r"error: there is no file .* <!-- results: start -->"):
            main(["--from", str(tmp_path / "runs.csv"), "--page", str(tmp_path / "README.md")])
