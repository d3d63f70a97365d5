"""The benchmark command runs and writes what it says."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from benchmarks import cost
from benchmarks import gpu as benchmarks_gpu
from benchmarks.setups import matrix_products
from benchmarks.timing import Row, alternate, fill_page, to_markdown
from benchmarks.zoo import arguments
from studies import cost as studies_cost
from studies import gpu
from studies.files import fill
from studies.gpu import NOT_MEASURED

REPOSITORY = Path(__file__).parent.parent
WHERE = {
    "cpu": "c",
    "cores": 2,
    "load": 0.0,
    "threads": 1,
    "commit": "abc1234",
    "versions": {},
    "python": "3",
}


@pytest.mark.slow
def test_the_command_writes_rows_as_json_and_as_a_table(tmp_path):
    """A quick run of two groups: valid JSON, one table line per row, ratios of the parts."""
    result, table = tmp_path / "speed.json", tmp_path / "speed.md"
    command = [sys.executable, "-m", "benchmarks.speed", "--quick", "--rows", "update", "cuda"]
    subprocess.run(
        [*command, "--json", str(result), "--markdown", str(table)],
        check=True,
        cwd=REPOSITORY,
        env={**os.environ, "CUDA_VISIBLE_DEVICES": ""},
        capture_output=True,
    )
    written = json.loads(result.read_text())
    rows = written["rows"]
    assert [row["group"] for row in rows] == ["update"] * 3 + ["cuda"] * 3
    parts = rows[0]["parts"]
    assert rows[0]["value"] == pytest.approx(parts["eager us"] / parts["compiled us"])
    assert rows[0]["met"] == (rows[0]["value"] >= rows[0]["at_least"])
    assert rows[3]["value"] is None and "no CUDA device" in rows[3]["note"]
    assert written["quick"] and written["machine"]["cpu"]
    assert torch.__version__.startswith(written["machine"]["versions"]["torch"])
    assert all(f"| {row['name']} |" in table.read_text() for row in rows)
    assert f"commit {written['machine']['commit']}" in table.read_text()


@pytest.mark.slow
@pytest.mark.parametrize("compiler", ["own", "torch.compile"])
def test_both_compilers_are_timed(compiler):
    """Later updates take a small part of the first one, which compiles."""
    command = [sys.executable, "-m", "benchmarks.compilers", "ppo_rpe", compiler]
    done = subprocess.run(command, check=True, cwd=REPOSITORY, capture_output=True, text=True)
    times = json.loads(done.stdout.splitlines()[-1])
    assert times["first_s"] > 10 * 1e-6 * times["update_us"] > 0


def test_alternate_takes_turns_and_gives_the_median_per_unit():
    """Of rounds of 1, 2 and 9 times 10 ms for two units, the median is 10 ms a unit."""
    turns, factors = [], iter([0, 1, 2, 9])

    def slow():
        turns.append("slow")
        time.sleep(0.01 * next(factors))
        return 2

    times = alternate({"slow": slow, "fast": lambda: turns.append("fast")}, repeats=3)
    assert turns == ["slow", "fast"] * 4
    assert 0.010 <= times["slow"] < 0.020
    assert times["fast"] < times["slow"]


def test_matrix_products_are_those_of_forward_and_backward():
    """A linear layer on 3 rows with a gradient to its input makes three: x W^T, g^T x and g W."""
    x = torch.randn(3, 4, requires_grad=True)
    layer = torch.nn.Linear(4, 5)
    multiply = matrix_products(lambda: layer(x).sum().backward())
    shapes = sorted(tuple(out.shape) for _, _, out in multiply.args[0])
    assert shapes == [(3, 4), (3, 5), (5, 4)]
    multiply()
    outs = [out for left, right, out in multiply.args[0] if out.shape == (3, 5)]
    torch.testing.assert_close(outs[0], x @ layer.weight.T)


@pytest.mark.parametrize(
    ("row", "met"),
    [
        (Row("g", "r", 4.0, at_least=4.0), True),
        (Row("g", "r", 1.3, at_most=1.25), False),
        (Row("g", "r", at_most=1.25, note="not measured"), None),
        (Row("g", "r", 2.0), None),
    ],
)
def test_a_row_meets_its_limit_or_not(row, met):
    """Limits count as met; nothing is met without a value or a limit."""
    assert row.met is met
    assert {True: "| yes |", False: "| no |", None: "| - |"}[met] in to_markdown([row], WHERE, "")


def test_a_table_has_its_command_and_its_commit():
    """So that it can be made again, and with the same code."""
    *_, where, _, fence, command, _ = to_markdown([], WHERE, "python -m benchmarks.speed").split(
        "\n"
    )
    assert where.startswith("Commit abc1234: ") and (fence, command) == (
        "```bash",
        "python -m benchmarks.speed",
    )


def test_a_table_replaces_the_one_between_the_marks():
    """The texts of the page stay."""
    page = "# Speed\n<!-- speed: start -->\nold\n<!-- speed: end -->\nLimits.\n"
    assert fill_page(page, "new") == page.replace("old", "new")
    assert fill_page("", "new") == "new\n"


def test_a_preset_goes_to_stable_baselines_as_the_zoo_has_it():
    """Hopper's settings by the names of the zoo's own file; Pendulum is not normalized."""
    hopper = arguments("hopper_v5")
    assert hopper["ppo"] == {
        "learning_rate": 9.80828e-05,
        "n_steps": 512,
        "batch_size": 32,
        "n_epochs": 5,
        "gamma": 0.999,
        "gae_lambda": 0.99,
        "clip_range": 0.2,
        "ent_coef": 0.00229519,
        "vf_coef": 0.835671,
        "max_grad_norm": 0.7,
    }
    assert hopper["policy"] == {
        "net_arch": {"pi": [256, 256], "vf": [256, 256]},
        "log_std_init": -2.0,
        "ortho_init": False,
        "activation_fn": "ReLU",
    }
    assert hopper["normalize"] == {"norm_obs": True, "norm_reward": True}
    pendulum = arguments("pendulum")
    assert (pendulum["num_envs"], pendulum["ppo"]["n_steps"]) == (4, 1024)
    assert not any(pendulum["normalize"].values())
    # Its own defaults, normalized, and a rate that falls.
    baselines = arguments("hopper_v5", "baselines")
    assert (baselines["ppo"]["n_steps"], baselines["ppo"]["vf_coef"]) == (2048, 0.5)
    assert baselines["linear"] and not hopper["linear"]


def test_the_cost_command_writes_every_regularizer(tmp_path, capsys):
    """With the baseline first, each fraction, and less memory with the smaller fraction."""
    path = tmp_path / "cost.json"
    cost.main(["--quick", "--fractions", "1", "0.25", "--json", str(path)])
    told, written = capsys.readouterr().out, json.loads(path.read_text())
    rows = written["rows"]
    names = [cost.BASELINE, *cost.VARIANTS, *cost.VARIANTS]
    assert [row["method"] for row in rows] == names
    assert rows[0]["memory"] == 1 and all(row["time"] > 0 for row in rows)
    for whole, quarter in zip(rows[1 : len(cost.VARIANTS) + 1], rows[-8:], strict=True):
        assert (whole["fraction"], quarter["fraction"]) == (1.0, 0.25)
        assert whole["memory"] > quarter["memory"] > 1
        assert f"64 states, {whole['method']}, fraction 1:" in told
    assert written["quick"] and written["device"] == "cpu"
    assert written["machine"]["versions"]["torch"] and written["machine"]["commit"]
    assert written["command"].startswith("python -m benchmarks.cost --quick")


def test_the_page_shows_the_measured_costs():
    """``python -m studies.cost`` would change nothing, and a quick run is not shown."""
    measured = json.loads(studies_cost.MEASURED.read_text())
    page = studies_cost.PAGE.read_text()
    assert fill(page, "cost", studies_cost.cost_table(measured)) == page
    assert not measured["quick"] and measured["machine"]["commit"] in page


def test_the_table_of_costs_by_hand():
    """The baseline's own numbers, and for the others multiples with their quartiles."""
    row = {"states": 4096, "fraction": 1.0, "time": 1.0, "time_low": 0.98, "time_high": 1.03}
    row |= {"method": "baseline", "milliseconds": 1234.5, "memory": 1.0, "memory_mib": 59.4}
    other = row | {"method": "L2C2", "time": 2.125, "memory": 2.02}
    quarter = other | {"fraction": 0.25, "time": 1.25}
    measured = {
        "command": "python -m benchmarks.cost",
        "machine": WHERE
        | {"cuda": None, "versions": dict.fromkeys(("torch", "torchrl", "tensordict"), "1")},
        "device": "cpu",
        "memory": "m",
        "rounds": 5,
        "networks": {"observations": 3, "actions": 2, "layers": [8, 4]},
        "rows": [row, other, quarter],
    }
    lines = studies_cost.cost_table(measured).splitlines()
    assert lines[0].startswith("`python -m benchmarks.cost`, commit abc1234, c, load 0.0")
    assert lines[2] == "| method | `fraction` | time, 4,096 states | memory, 4,096 states |"
    assert lines[4:7] == [
        "| baseline | 1 | 1,234 ms | 59 MiB |",
        "| L2C2 | 1 | 2.12 (0.98, 1.03) | 2.02 |",
        "| L2C2 | 0.25 | 1.25 (0.98, 1.03) | 2.02 |",
    ]


def test_the_cost_command_refuses_a_device_without_a_measure_of_memory():
    """Its memory would not be comparable."""
    with pytest.raises(SystemExit, match=r"Expected --device cpu or cuda, got 'mps'\."):
        cost.main(["--device", "mps"])


def test_saved_tensors_count_while_they_are_saved():
    """A storage once, whoever shares it; what is freed and ignored not at all."""
    x = torch.randn(256, requires_grad=True)
    shared = torch.randn(2, 256)
    with cost.SavedTensors([x]) as saved:
        for _ in range(3):
            (x * shared[0] * x * shared[1]).sum().backward()
    # `shared`, and the first product, as a factor of the next one.
    assert saved.peak == 4 * (512 + 256)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_the_cost_command_measures_on_cuda(tmp_path):
    """Less memory with the smaller fraction, by the allocator's peak."""
    path = tmp_path / "cost.json"
    cost.main(["--device", "cuda", "--states", "4096", "--rounds", "1", "--json", str(path)])
    rows = json.loads(path.read_text())["rows"]
    for whole, quarter in zip(rows[1 : len(cost.VARIANTS) + 1], rows[-8:], strict=True):
        assert whole["memory"] > quarter["memory"] > 1, whole["method"]


@pytest.mark.slow
def test_the_script_for_a_gpu_runs_its_parts_without_one(tmp_path):
    """Tests are skipped; what is not there is said; the page has a section for each part."""
    script = REPOSITORY / "benchmarks" / "gpu.sh"
    done = subprocess.run(
        [script, "--cpu", "--quick"],
        env={
            **os.environ,
            "CUDA_VISIBLE_DEVICES": "",
            "OUT": str(tmp_path),
            "PYTHON": sys.executable,
        },
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert [line.split(":")[0] for line in done.stdout.splitlines()] == [
        "cost",
        "tests",
        "speed",
        "brax",
    ]
    tests = json.loads((tmp_path / "tests.json").read_text())["tests"]
    assert len(tests) > 5 and {test["outcome"] for test in tests} == {"skipped"}
    gpu.main([str(tmp_path), "--output", str(tmp_path / "gpu.md")])
    page = (tmp_path / "gpu.md").read_text()
    assert NOT_MEASURED not in page and "no CUDA device" in page
    assert "quick run, which say nothing" in page and "| L2C2 | 0.25 |" in page


def test_a_training_is_stopped_at_its_limit_and_keeps_its_iterations(tmp_path, monkeypatch):
    """The baseline ends, L2C2 hangs after its first iteration."""
    example = tmp_path / "example.py"
    example.write_text(
        "import sys, time\n"
        "print('1: reward 0.500, action variation 0.250')\n"
        "if '--baseline' not in sys.argv:\n    time.sleep(60)\n"
    )
    monkeypatch.setattr(benchmarks_gpu, "EXAMPLE", example)
    monkeypatch.setattr(benchmarks_gpu, "why_not", lambda given: "")
    path = tmp_path / "brax.json"
    benchmarks_gpu.main(["brax", "--json", str(path), "--seconds", "2", "--envs", "4"])
    measured = json.loads(path.read_text())
    assert [run["ended"] for run in measured["runs"]] == [True, False]
    assert measured["command"] == "python examples/brax_ant.py --envs 4"
    rows = gpu.brax_table(measured).splitlines()[-2:]
    assert [row.split(" | ")[1] for row in rows] == ["1", "1, stopped"]
    assert all(row.endswith("| 0.500 | 0.250 |") for row in rows)


def test_the_page_of_a_gpu_names_what_was_not_measured(tmp_path):
    """Of a folder with one part the others have no table; an empty folder is refused."""
    with pytest.raises(FileNotFoundError, match=r"Expected results of .*gpu\.sh in .*, got none"):
        gpu.gpu_page(tmp_path)
    tests = [{"test": "test_it", "outcome": "passed", "seconds": 1.25}]
    where = WHERE | {"cuda": "A card"}
    (tmp_path / "tests.json").write_text(json.dumps({"machine": where, "tests": tests}))
    page = gpu.gpu_page(tmp_path)
    assert page.count(NOT_MEASURED) == 3 and "| `test_it` | passed | 1.2 |" in page
    assert "commit abc1234, A card, Python 3" in page
