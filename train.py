"""Trains one run of the paper's experiment: `python train.py task=swingup regularizer=l2c2`.

`python train.py --help` lists every setting; `-m` runs several values of some one after another.
"""

from torchrl_l2c2.experiment.cli.train import main

if __name__ == "__main__":
    main()
