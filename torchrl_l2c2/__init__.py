"""Locally Lipschitz continuous constraint (L2C2) for TorchRL.

The public names are listed, with the modules they live in, in ``__init__.pyi``. A module is
imported when one of its names is first used, as TorchRL's own are: importing the package takes next
to no time.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
