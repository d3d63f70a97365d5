"""``python -m torchrl_l2c2``: what there is."""

from torchrl_l2c2._version import __version__

COMMANDS = f"""\
torchrl_l2c2 {__version__}: locally Lipschitz continuous policies and value functions for TorchRL

In Python

  from torchrl_l2c2 import L2C2Loss, Neighborhood    docs/components.md; help(L2C2Loss)
  from torchrl_l2c2.experiment import Experiment     the paper's experiment, without a shell

Commands, with the extra "experiment": pip install "torchrl-l2c2[experiment]"

  python -m torchrl_l2c2.experiment task=hopper      trains; --help lists every setting
  python -m torchrl_l2c2.experiment -m seed=0,1,2    trains several, one after another
  python -m torchrl_l2c2.experiment.evaluate FOLDER  plays test episodes with a run's policy
  python -m torchrl_l2c2.experiment.video FOLDER     a video of an episode
  python -m torchrl_l2c2.experiment.export FOLDER    its policy as ONNX
  python -m torchrl_l2c2.experiment.diagnose FOLDER  a page of why its policy shakes
  python -m torchrl_l2c2.experiment.noise FOLDER     how the policies below it bear noise
  python -m torchrl_l2c2.experiment.reports FOLDER   tables and pictures of the runs below a folder
  python -m torchrl_l2c2.experiment.manual           docs/settings.md

torchrl-l2c2 is the first of them. The README, docs/ and examples/ of the source have the rest.
"""

if __name__ == "__main__":
    print(COMMANDS, end="")
