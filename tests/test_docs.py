"""README and docs/ are true: their code runs, their names and numbers are the package's."""

from __future__ import annotations

import base64
import json
import re
import runpy
from pathlib import Path
from typing import Any
from unittest.mock import patch

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from scipy.integrate import quad
from tensordict import TensorDict
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.modules import (
    IndependentNormal,
    ProbabilisticActor,
    ValueOperator,
)
from torchrl.objectives import ClipPPOLoss, SACLoss

import torchrl_l2c2
from torchrl_l2c2 import affinities, smooth
from torchrl_l2c2.experiment.analysis.diagnosis import diagnose_actions, findings
from torchrl_l2c2.experiment.analysis.diagnosis.measured import FEWEST_STEPS
from torchrl_l2c2.experiment.analysis.diagnosis.words import threshold
from torchrl_l2c2.experiment.cli import diagnose as diagnose_command
from torchrl_l2c2.experiment.learn.learner import MEASURE_AFTER, WARN_BELOW
from torchrl_l2c2.presets import KINDS, PRESETS

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs"
COMPONENTS = FOLDER / "components.md"
DISTANCES = FOLDER / "distances.md"
PLAIN = FOLDER / "plain_pytorch.md"
# An HTML comment right before a block keeps it from being run.
BLOCK = re.compile(r"(?P<skip><!-- no-test -->\s*)?^```python\n(?P<code>.*?)^```", re.M | re.S)
PAGES = [
    path
    for path in (ROOT / "README.md", *sorted(FOLDER.glob("*.md")))
    if BLOCK.search(path.read_text())
]


def run_blocks(page: Path) -> dict[str, Any]:
    """Runs a page's Python blocks in order, in one namespace; errors show the page's lines."""
    text = page.read_text()
    namespace: dict[str, Any] = {"__name__": page.name}
    # What a page registers is not to reach other tests.
    with patch.dict(affinities._LOG_AFFINITIES):
        for block in BLOCK.finditer(text):
            if block["skip"] is None:
                line = text.count("\n", 0, block.start("code"))
                exec(compile("\n" * line + block["code"], str(page), "exec"), namespace)
    return namespace


@pytest.fixture(scope="module")
def components() -> dict[str, Any]:
    """What the page of the components has defined when all of it has run."""
    torch.manual_seed(0)
    return run_blocks(COMPONENTS)


@pytest.fixture(scope="module")
def mean_gain() -> Any:
    """The function of the page of distances and gains."""
    return run_blocks(DISTANCES)["mean_gain"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_blocks_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The code of every page runs from top to bottom."""
    # For what a page writes.
    monkeypatch.chdir(tmp_path)
    run_blocks(page)


def test_what_is_summed_is_every_loss() -> None:
    """DQN and its kin call theirs ``loss``: snippets that are copied do not leave it out."""
    written = [*FOLDER.glob("*.md"), *ROOT.glob("examples/*.py"), ROOT / "README.md"]
    sums = [line for path in written for line in path.read_text().splitlines() if "sum(" in line]
    found = [line for line in sums if "startswith(" in line]
    assert found and all('startswith("loss")' in line for line in found)


def test_the_readmes_code_does_what_it_says() -> None:
    """Nothing of it is left out, and the loss has the promised terms."""
    page = ROOT / "README.md"
    assert "<!-- no-test -->" not in page.read_text()
    defined = run_blocks(page)
    assert isinstance(defined["loss"], SACLoss)
    assert {"penalty_l2c2_actor", "l2c2_mean_distance"} <= set(defined["terms"].keys())
    assert defined["ppo"].regularizer_gain.item() == 0.25


def presets_table() -> str:
    """The table of presets as Markdown."""
    lines = ["| loss | method | settings | evidence |", "| --- | --- | --- | --- |"]
    for kind, (exact, _) in KINDS.items():
        for method, kinds in PRESETS.items():
            chosen = kinds[kind]
            shown = ", ".join(f"`{name}={value!r}`" for name, value in chosen.shown.items())
            page = f"[{chosen.tasks}](../{chosen.evidence})" if chosen.evidence else "no runs"
            lines.append(f"| {exact[0]} | {method} | {shown} | {page} |")
    return "\n".join(lines) + "\n"


def test_the_guide_shows_the_table_of_presets() -> None:
    """As the package has it; pages that are named as evidence exist."""
    page = (FOLDER / "smooth_policy.md").read_text()
    shown = re.search(r"<!-- presets -->\n(.*)<!-- presets end -->", page, re.S)
    assert shown is not None and shown[1] == presets_table()
    for kinds in PRESETS.values():
        assert kinds.keys() == KINDS.keys()
        for preset in kinds.values():
            assert preset.evidence is None or (ROOT / preset.evidence).exists()


def test_the_function_without_torchrl_is_the_presets_penalty() -> None:
    """With the same random numbers; the gains that the page names are those of the presets."""
    defined = run_blocks(PLAIN)
    mean, observation = defined["actor_mean"], torch.randn(32, 3)
    successor, ended = observation + 0.1 * torch.randn(32, 3), torch.arange(32) % 5 == 0
    done = ended.unsqueeze(-1)
    batch = TensorDict({"observation": observation, "action": torch.zeros(32, 1)}, [32])
    batch["next"] = {"observation": successor, "done": done, "terminated": done}
    with_scale = nn.Sequential(mean, AddStateIndependentNormalScale(1))
    actor = ProbabilisticActor(
        TensorDictModule(with_scale, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
    )
    critic = ValueOperator(nn.Linear(3, 1), in_keys=["observation"])
    loss = smooth(ClipPPOLoss(actor, critic), fold=False, ramp=None, skip_ends=True)
    torch.manual_seed(0)
    expected = loss.policy_regularizer(batch)["loss_l2c2_actor"]
    torch.manual_seed(0)
    torch.testing.assert_close(defined["l2c2"](mean, observation, successor, ended), expected)
    for kind in ("ppo", "sac", "td3"):
        chosen = PRESETS["l2c2"][kind].settings
        gains = f"lambda_min={chosen['lambda_min']:g}", f"lambda_max={chosen['lambda_max']:g}"
        assert re.search(r"(\.0)?, ".join(map(re.escape, gains)), PLAIN.read_text())


class Counter(gymnasium.Env[np.ndarray, np.ndarray]):
    """Its observation counts the steps of an episode, which has five."""

    observation_space = gymnasium.spaces.Box(0.0, 5.0, (1,))
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def reset(self, **kwargs: Any) -> tuple[np.ndarray, dict[str, Any]]:
        self.count = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.count += 1
        return np.full(1, self.count, np.float32), 0.0, self.count == 5, False, {}


@pytest.mark.parametrize("mode", ["NEXT_STEP", "SAME_STEP"])
def test_no_reset_is_among_the_transitions_without_torchrl(mode: str) -> None:
    """However Gymnasium's vector environments reset: the page's lines on a loop like CleanRL's."""
    envs = SyncVectorEnv([Counter] * 2, autoreset_mode=AutoresetMode[mode])
    steps, environments = 23, 2
    obs, dones = torch.zeros(steps, environments, 1), torch.zeros(steps, environments)
    next_obs, next_done = torch.tensor(envs.reset(seed=0)[0]), torch.zeros(environments)
    for step in range(steps):
        obs[step], dones[step] = next_obs, next_done
        observed, _, terminated, truncated, _ = envs.step(np.zeros((environments, 1), np.float32))
        next_obs, next_done = torch.tensor(observed), torch.tensor(terminated | truncated).float()
    (lines,) = re.findall(r"^(successors = .*?)^batch", PLAIN.read_text(), re.M | re.S)
    names = {"torch": torch, **locals()}
    exec(lines, names)
    moved = (names["successors"] - obs.flatten(0, 1))[names["ended"] == 0]
    assert (moved == 1).all() and len(moved) >= 0.6 * steps * environments


def test_the_quickstart_is_the_notebook() -> None:
    """The page's training runs; its numbers and picture are saved outputs of the notebook."""
    page = FOLDER / "quickstart.md"
    policy = run_blocks(page)["train"](strength=1.0, iterations=1)
    assert policy(TensorDict({"observation": torch.zeros(2)}))["action"].shape == (1,)
    notebook = json.loads((ROOT / "notebooks" / "quickstart.ipynb").read_text())
    saved = [output for cell in notebook["cells"] for output in cell.get("outputs", [])]
    printed = "".join("".join(output.get("text", "")) for output in saved)
    (numbers,) = re.findall(r"^```text\n(.*?)^```", page.read_text(), re.M | re.S)
    assert all(line in printed for line in numbers.splitlines())
    pictures = [
        output["data"]["image/png"] for output in saved if "image/png" in output.get("data", {})
    ]
    assert base64.b64decode(pictures[-1]) == (FOLDER / "quickstart.png").read_bytes()


def test_the_page_shows_what_diagnose_says_of_a_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of the file that the page writes, by its own command."""
    monkeypatch.chdir(tmp_path)
    page = FOLDER / "shaking.md"
    run_blocks(page)
    capsys.readouterr()
    command, shown = re.findall(r"^```(?:bash|text)\n(.*?)^```", page.read_text(), re.M | re.S)[1:3]
    diagnose_command.main(command.split()[4:])
    assert capsys.readouterr().out == shown


def test_the_pictured_actions_have_their_findings() -> None:
    """Of each, the first finding is the one in its title; the red ones are faults."""
    made = runpy.run_path(str(FOLDER / "make_findings.py"))
    found = {
        kind: findings(diagnose_actions(action, bounds=(-1.0, 1.0)))[0]
        for kind, (_, action) in made["signals"]().items()
    }
    assert all(each.kind == kind for kind, each in found.items())
    assert [kind for kind, each in found.items() if not each.fault] == ["smooth"]


def test_the_pages_have_the_thresholds_of_diagnose() -> None:
    """Each is in the row of its finding; the page about gradients has the threshold of a run."""
    page = (FOLDER / "shaking.md").read_text()
    rows = dict(re.findall(r"^\| ([^|]+) \| ([^|]+) \|", page, re.M))
    for finding, thresholds in {
        "flips from step to step": [threshold("FLIPS")],
        "chatters": [threshold(name) for name in ("CHATTERS", "FAST", "FAST_HERTZ")],
        "moves like noise": [threshold("ROUGH"), threshold("SMOOTH")],
        "bang-bang": [threshold("BANG_BANG"), threshold("EITHER_BOUND")],
        "pinned": [threshold("BANG_BANG")],
        "sensitive to noise": [threshold("NOISY"), threshold("MOSTLY")],
        "steep spots": [threshold("STEEP")],
        "follows one input": [threshold("FOLLOWS")],
        "wide samples": [threshold("WIDE")],
        "small terms": [threshold("SMALL")],
        "stands still": [threshold("STILL")],
        "smooth": [threshold("SMOOTH")],
        "the episodes differ": [threshold("UNLIKE")],
        "too short": [FEWEST_STEPS],
    }.items():
        assert {f"{each:g}" for each in thresholds} <= set(re.findall(r"-?[\d.]*\d", rows[finding]))
    assert f"at least {threshold('CONCENTRATED'):g} of a change" in page
    check = (FOLDER / "check.md").read_text()
    assert f"| below {threshold('SMALL'):g} |" in check and f"| below {WARN_BELOW:.4f} |" in check
    assert f"after {MEASURE_AFTER} updates" in check


def test_a_marked_block_is_left_out_and_the_others_share_a_namespace(tmp_path: Path) -> None:
    """An error in a block shows, one after the mark does not."""
    page = tmp_path / "page.md"
    page.write_text(
        "```python\na = 1\n```\n<!-- no-test -->\n```python\nraise ValueError\n```\n"
        "```bash\nfalse\n```\n```python\nb = a + 1\n```\n"
    )
    assert run_blocks(page)["b"] == 2
    page.write_text("text\n\n```python\nraise ValueError\n```\n")
    with pytest.raises(ValueError) as raised:
        run_blocks(page)
    assert raised.traceback[-1].lineno == 3  # counted from 0: the page's fourth line


def test_every_public_name_has_a_section_that_uses_it(components: dict[str, Any]) -> None:
    """Nothing public is left out, and each section runs what it is about."""
    sections = re.split(r"^## ", COMPONENTS.read_text(), flags=re.M)[1:]
    for name in torchrl_l2c2.__all__:
        described = [s for s in sections if f"`{name}`" in s.splitlines()[0]]
        assert len(described) == 1, name
        code = "".join(block["code"] for block in BLOCK.finditer(described[0]))
        assert re.search(rf"\b{name}\b", code), name
        assert components[name] is getattr(torchrl_l2c2, name)


WRITTEN = sorted(
    path
    for folder in (ROOT, FOLDER, ROOT / "results", ROOT / "studies")
    for path in folder.glob("*.md")
)


@pytest.mark.parametrize("page", WRITTEN, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_link_leads_to_a_file_and_its_heading(page: Path) -> None:
    """From the file itself, with headings as GitHub names them; the site finds the same parts."""
    for path, _, heading in re.findall(r"\]\((?!https?:)([^#)\s]*)(#?)([^)\s]*)\)", prose(page)):
        target = (page.parent / path if path else page).resolve()
        assert target.exists(), path
        headings = re.findall(r"^#+ (.*)$", prose(target), re.M) if heading else []
        anchors = {re.sub(r"[^\w\- ]", "", each.lower()).replace(" ", "-") for each in headings}
        assert not heading or heading in anchors, (path, heading)


def prose(page: Path) -> str:
    """A page without its blocks of code."""
    return re.sub(r"^```.*?^```", "", page.read_text(), flags=re.M | re.S)


def test_the_mean_gains_are_right(mean_gain: Any) -> None:
    """The page's table and its formula, against quadrature over the largest of n draws."""
    text = DISTANCES.read_text()
    rows = {
        name: [float(cell) for cell in cells.split("|")[:-1]]
        for name, cells in re.findall(r"^\| (mean [^|]*?) \|(.*)$", text, re.M)
    }
    near = torchrl_l2c2.Neighborhood(1.0, 0.01, 1.0)
    for column, n in enumerate((1, 2, 5, 9, 15, 28)):

        def mean(function: Any, n: int = n) -> float:
            # The density of the largest of n draws from [0, r] is n x^(n-1) / r^n; here r = 1.
            return quad(lambda x: n * x ** (n - 1) * function(x), 0.0, near.radius)[0]

        gain = mean(lambda x: near.scale / (x + near.epsilon))
        assert mean_gain(near, n) == pytest.approx(gain, rel=1e-8)
        assert rows["mean gain"][column] == pytest.approx(gain, abs=0.5001e-4)
        distance = rows["mean distance, less epsilon"][column]
        assert distance == pytest.approx(mean(lambda x: x), abs=0.5001e-3)


def test_the_loss_has_the_gain_of_the_page(components: dict[str, Any], mean_gain: Any) -> None:
    """The diagnostics of a long batch are the means that the page predicts."""
    torch.manual_seed(0)
    near, loss = components["near"], components["loss"]
    rollout = components["rollout"][:64].repeat(500)
    with torch.no_grad():
        terms = loss(rollout)
    # In three dimensions the gain's standard deviation is 0.008, the distance's 0.19.
    assert terms["l2c2_gain"].item() == pytest.approx(mean_gain(near, 3), abs=3e-4)
    assert terms["l2c2_distance"].item() == pytest.approx(0.75 + near.epsilon, abs=6e-3)
