"""The base class of transforms that draw random numbers."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs import EnvBase, Transform


class RandomTransform(Transform):
    """A transform whose own generator, if it has one, is part of its ``state_dict``."""

    def __init__(self, in_keys: Any, out_keys: Any, generator: torch.Generator | None) -> None:
        if generator is not None and not isinstance(generator, torch.Generator):
            raise TypeError(
                f"generator must be a torch.Generator or None, got {generator!r}: pass "
                "torch.Generator().manual_seed(seed)."
            )
        super().__init__(in_keys=in_keys, out_keys=out_keys)
        self.generator = generator

    def __getstate__(self) -> dict[str, Any]:
        """The state with the generator as numbers: torch cannot send one to a new process."""
        state = super().__getstate__()
        if self.generator is not None:
            numbers = self.generator.get_state().numpy()
            state["generator"] = (str(self.generator.device), numbers)
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        if state["generator"] is not None:
            device, numbers = state["generator"]
            generator = torch.Generator(device)
            generator.set_state(torch.from_numpy(numbers.copy()))
            state = {**state, "generator": generator}
        super().__setstate__(state)

    def set_container(self, container: Any) -> None:
        super().set_container(container)
        parent = self.parent
        if parent is not None:
            try:
                self._check_environment(parent)
            except Exception:
                self.reset_parent()  # To be put elsewhere.
                raise

    def _check_environment(self, env: EnvBase) -> None:
        """Refuses an environment that cannot take the transform."""

    def get_extra_state(self) -> Tensor:
        # Not None: some ways of saving take tensors only.
        return torch.empty(0) if self.generator is None else self.generator.get_state()

    def set_extra_state(self, state: Tensor) -> None:
        saved, present = state.numel() > 0, self.generator is not None
        if saved != present:
            with_or_without = {True: "with", False: "without"}
            raise ValueError(
                f"{type(self).__name__} was saved {with_or_without[saved]} a generator and built "
                f"{with_or_without[present]} one: build it as it was built then."
            )
        if self.generator is None:
            return
        state = state.cpu()  # Wherever a checkpoint was loaded to.
        if state.shape != self.generator.get_state().shape:
            raise ValueError(
                f"{type(self).__name__} was saved with a generator of another kind of device than "
                f"{self.generator.device}: build it with one of the device that it had then."
            )
        self.generator.set_state(state)


def listed(entries: TensorDictBase | Composite) -> str:
    """The entries' names, for errors."""
    return ", ".join(sorted(map(str, entries.keys(True, True)))) or "no entries"
