"""The Pareto front of return and smoothness, by hand and by Optuna."""

import csv
import re

import numpy as np
import pytest

from tests.test_reports import make_config, make_run
from torchrl_l2c2.experiment import L2C2Config
from torchrl_l2c2.experiment.front import draw_front, front_table, front_test, pareto_front
from torchrl_l2c2.experiment.reports import read_runs, write_report
from torchrl_l2c2.experiment.reports.groups import by_task, group_records

# beta -> return and action variation; 1 and 3 are alike, 5 is beaten in one by 4.
SETTINGS = {
    1: (100.0, 0.05),
    2: (90.0, 0.05),
    3: (100.0, 0.05),
    4: (120.0, 0.08),
    5: (120.0, 0.09),
    6: (50.0, 0.02),
    7: (110.0, 0.10),
}


def groups(folder, settings):
    for beta, (total, variation) in settings.items():
        for seed in (0, 1):
            config = make_config(regularizer=L2C2Config(beta=float(beta)), seed=seed)
            shift = 4.0 if seed else -4.0  # the mean over seeds is what counts
            make_run(folder / f"{beta}_{seed}", config, total + shift, variation)
    return group_records(run.record for run in read_runs(folder))


def forget(folder, *columns):
    """Runs as if these had not been measured: ``late_share=0`` measures no late tests."""
    for path in folder.rglob("metrics.csv"):
        lines = [row | dict.fromkeys(columns, "nan") for row in csv.DictReader(path.open())]
        with open(path, "w", newline="") as file:
            writer = csv.DictWriter(file, list(lines[0]))
            writer.writeheader()
            writer.writerows(lines)


def test_the_front_is_what_nothing_beats(tmp_path):
    """From the smoothest on; equal ones are all on it."""
    front = pareto_front(groups(tmp_path, SETTINGS), "late_mean")
    betas = [group.first.other_settings["regularizer.beta"] for group in front]
    assert betas[0] == "6" and set(betas[1:3]) == {"1", "3"} and betas[3:] == ["4"]


def test_the_front_is_optunas(tmp_path):
    """On random points, by its own definition."""
    optuna = pytest.importorskip("optuna")
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    draws = np.random.default_rng(0)
    settings = {beta: (draws.integers(0, 40), draws.integers(1, 40) / 400) for beta in range(1, 40)}
    study = optuna.create_study(directions=["maximize", "minimize"])
    for values in settings.values():
        study.add_trial(optuna.trial.create_trial(values=list(values)))
    ours = pareto_front(groups(tmp_path, settings), "late_mean")
    found = {float(group.first.other_settings["regularizer.beta"]) for group in ours}
    assert found == {trial.number + 1.0 for trial in study.best_trials}


def test_the_table_and_its_picture_are_numbered_alike(tmp_path):
    """From the smoothest on; and the number of settings is that of those that were measured."""
    many = groups(tmp_path / "many", SETTINGS)
    table = front_table(many, "late_mean")
    # make_run: the late policies' mean is 12 more than the total.
    assert table.rows[0] == ["1", "L2C2, beta=6", "0, 1", "62.00 (5.66)", "0.032 (0.000)"]
    assert table.rows[3][:2] == ["4", "L2C2, beta=4"] and len(table.rows) == 4
    assert "of 7 settings" in table.notes[0]
    draw_front(many, "late_mean", tmp_path / "front.svg")
    picture = (tmp_path / "front.svg").read_text()
    assert set("1234") <= set(re.findall(r">(\d)</text>", picture))


def test_without_late_tests_the_front_is_of_the_last_policies(tmp_path):
    """``late_share=0``, as presets have it."""
    groups(tmp_path / "runs", SETTINGS)
    forget(tmp_path / "runs", "test_return", "test_action_variation")
    (found,) = by_task(group_records(run.record for run in read_runs(tmp_path / "runs")))
    assert front_test(found) == "last_mean"
    # make_run: the last policy's is 20 more than the total.
    row = front_table(found, "last_mean").rows[0]
    assert row == ["1", "L2C2, beta=6", "0, 1", "70.00 (5.66)", "0.040 (0.000)"]


def test_a_report_that_cannot_be_drawn_leaves_none(tmp_path):
    """Nor a half of one: a picture without its page would pass for all there is."""
    records = [r for group in groups(tmp_path / "runs", SETTINGS) for r in group.records]

    def fail(_):
        raise ValueError("no picture")

    with pytest.raises(ValueError, match="no picture"):
        write_report(tmp_path / "report", records, pictures={"front.svg": fail})
    assert not (tmp_path / "report").exists()
