"""``export``: writes a policy as ONNX and as a ``torch.export`` program."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence

from torchrl_l2c2.experiment.errors import one_line_errors


def main(arguments: Sequence[str] | None = None) -> None:
    """Exports a policy and prints its contract."""
    parser = argparse.ArgumentParser(
        prog="python -m torchrl_l2c2 export",
        description="Writes a run's policy (mean actions) as ONNX and as a torch.export program.",
    )
    add = parser.add_argument
    add("folder", help="run folder, finished or not")
    add("--output", help="folder of the files (default: export/ in the run folder)")
    add("--best", action="store_true", help="policy_best.pt instead of policy.pt")
    add(
        "--episodes",
        type=int,
        default=1,
        help="number of episodes that compare the exported policies with the original (default: 1)",
    )
    chosen = parser.parse_args(arguments)
    if chosen.episodes < 1:
        parser.error(f"--episodes must be at least 1, got {chosen.episodes}")
    with one_line_errors():
        from torchrl_l2c2.experiment.analysis.export import export_policy

        exported = export_policy(
            chosen.folder, chosen.output, best=chosen.best, episodes=chosen.episodes
        )
    print(json.dumps(exported.contract, indent=2))
    print(f"policy.onnx, policy.pt2 and contract.json: {exported.folder}", file=sys.stderr)
