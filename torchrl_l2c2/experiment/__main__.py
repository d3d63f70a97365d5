"""``python -m torchrl_l2c2.experiment task=hopper``: the experiments, without a clone."""

from torchrl_l2c2.experiment.command import main

if __name__ == "__main__":
    main()
