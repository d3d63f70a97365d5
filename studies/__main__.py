"""Writes every generated table and picture: ``python -m studies``."""

from studies import deployments, forest, pages, strength

if __name__ == "__main__":
    for each in (pages, forest, strength, deployments):
        each.main()
