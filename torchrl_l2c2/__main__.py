"""``python -m torchrl_l2c2``: the command."""

from torchrl_l2c2.experiment.cli.main import main

if __name__ == "__main__":
    main()
