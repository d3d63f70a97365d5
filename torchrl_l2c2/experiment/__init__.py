"""The paper's experiment, built from the components: needs the ``experiment`` extra.

The public names are listed, with the modules they live in, in ``__init__.pyi``; a module is
imported when one of its names is first used, so that settings are read without waiting for torch.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
