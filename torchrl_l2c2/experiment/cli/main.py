"""The command ``python -m torchrl_l2c2``, with its subcommands."""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec

from torchrl_l2c2._version import __version__
from torchrl_l2c2.experiment.errors import how_to_install

# Packages of the experiment extra, which the components do not need.
PACKAGES = ("gymnasium", "hydra", "pydantic", "matplotlib", "pandas", "jinja2", "tqdm", "filelock")
# Name: module and help. Each module has a function ``main(arguments)``.
COMMANDS = {
    "train": ("train", "trains a policy, for example: train task=hopper seed=1"),
    "evaluate": ("evaluate", "plays test episodes, also with noise on observations"),
    "diagnose": ("diagnose", "writes a page that shows why policies shake"),
    "report": ("report", "writes tables and learning curves of runs"),
    "export": ("export", "writes a policy as ONNX and as a torch.export program"),
    "video": ("video", "records test episodes"),
    "settings": ("manual", "prints all settings as Markdown"),
}
HELP = (
    f"torchrl_l2c2 {__version__}: policies that do not shake, for TorchRL\n\n"
    "usage: python -m torchrl_l2c2 COMMAND ...\n\n"
    + "\n".join(f"  {name:10}{text}" for name, (_, text) in COMMANDS.items())
    + "\n\nCOMMAND --help lists the options of a command. In Python: help(torchrl_l2c2.smooth).\n"
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Runs a subcommand.

    Args:
        arguments (sequence of str, optional): Subcommand and its options. Default: the process's
            command line.

    Raises:
        SystemExit: If the subcommand is unknown or a package is missing, with one line.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or given[0] in ("-h", "--help"):
        print(HELP, end="")
        return
    name, rest = given[0], given[1:]
    if name not in COMMANDS:
        hint = f" Did you mean: train {' '.join(given)}" if "=" in name else ""
        sys.exit(f"error: Expected one of {', '.join(COMMANDS)}, got {name!r}.{hint}")
    if missing := [each for each in PACKAGES if find_spec(each) is None]:
        needed = ", ".join(missing)
        sys.exit(f"error: {name} needs the packages {needed}. {how_to_install('experiment')}")
    try:
        command = import_module(f"torchrl_l2c2.experiment.cli.{COMMANDS[name][0]}")
    except KeyboardInterrupt:  # Imports take a second.
        print("interrupted.", file=sys.stderr)
        sys.exit(128 + signal.SIGINT)
    command.main(rest)
