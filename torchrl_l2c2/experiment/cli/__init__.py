"""The command: its subcommands, Hydra, sweeps."""
