"""``python -m torchrl_l2c2.experiment task=hopper``, short for ``python -m torchrl_l2c2 train``."""

import sys

from torchrl_l2c2.experiment.cli.main import main

if __name__ == "__main__":
    main(["train", *sys.argv[1:]])
