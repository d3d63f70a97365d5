"""The paper's experiment, built from the components. Requires the ``experiment`` extra.

``__init__.pyi`` lists the public names and their modules. A module is imported when one of its
names is first used: settings do not import torch.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
