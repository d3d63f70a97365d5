"""What gains that follow a target were asked for, by hand."""

import pytest

from tests.test_reports import make_config, make_run
from torchrl_l2c2.experiment import L2C2Config
from torchrl_l2c2.experiment.reports import read_runs
from torchrl_l2c2.experiment.reports.__main__ import main
from torchrl_l2c2.experiment.reports.gain_targets import gain_targets_table


def asked(target, **settings):
    return L2C2Config(gain="target", gain_target=target, **settings)


@pytest.fixture
def folder(tmp_path):
    """Two seeds of .05, one of .02, vanilla, and what is no such run."""
    for name, regularizer, seed, varied in (
        ("one", asked(0.05), 0, 0.04),
        ("two", asked(0.05), 1, 0.05),
        ("low", asked(0.02), 0, 0.02),
        ("none", "none", 0, 0.1),
        ("constant", "l2c2", 0, 0.08),
        ("other measure", asked(0.3, gain_of="policy_scale"), 0, 0.07),
    ):
        config = make_config(regularizer=regularizer, seed=seed)
        make_run(tmp_path / name, config, 100.0 * (seed + 1), varied)
    return tmp_path


def test_a_row_has_what_was_asked_for_what_came_and_what_it_cost(folder):
    """Late policies with samples: .045 of .05 is a tenth less; the last one's mean is 20 more."""
    table = gain_targets_table([run.record for run in read_runs(folder)])
    assert table.columns[4:7] == ["target", "followed", "off by"]
    assert [row[2:7] for row in table.rows] == [
        ["L2C2, gain_target=0.02", "0", "0.020", "0.020", "+0%"],
        ["L2C2, gain_target=0.05", "0, 1", "0.050", "0.045 (0.007)", "-10%"],
        ["vanilla", "0", "", "0.100", ""],
    ]
    assert [row[7:] for row in table.rows] == [
        ["100.0", "0.500", "0.040", "120.0"],
        ["150.0 (70.7)", "0.500 (0.000)", "0.065 (0.007)", "170.0 (70.7)"],
        ["100.0", "0.500", "0.120", "120.0"],
    ]


def test_without_such_a_gain_there_is_no_table(folder):
    """Nor where another measure is followed, which no record has."""
    records = [run.record for run in read_runs(folder)]
    others = [record for record in records if "gain_target=0.0" not in record.differences]
    assert len(others) == 3 and gain_targets_table(others) is None


def test_the_end_of_a_sweep_and_a_report_tell_it(folder, capsys):
    """Whoever asks for an action variation sees whether it came."""
    main([str(folder), "--output", str(folder / "report")])
    title = "**Targets of the action variation**"
    assert title in capsys.readouterr().out
    assert title in (folder / "report" / "report.md").read_text()
