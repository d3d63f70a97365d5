"""Writes every generated table and picture: ``python -m studies``."""

import argparse

from studies import deployments, forest, pages, strength

if __name__ == "__main__":
    argparse.ArgumentParser(prog="python -m studies", description=__doc__).parse_args()
    for each in (pages, forest, strength, deployments):
        each.main()
