"""Trains one run of the paper's experiment: `python train.py task=swingup regularizer=l2c2`.

`python train.py --help` lists every setting; `-m` trains one run for each value of a setting.
"""

import sys

from torchrl_l2c2.experiment.cli.main import main

if __name__ == "__main__":
    main(["train", *sys.argv[1:]])
