"""The command line: subcommands, Hydra and sweeps."""
