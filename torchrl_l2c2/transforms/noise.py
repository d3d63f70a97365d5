"""White noise on observations."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import EnvBase

from torchrl_l2c2._checks import check_real
from torchrl_l2c2.transforms.random import RandomTransform, listed


class ObservationNoise(RandomTransform):
    """Adds white Gaussian noise to the observations of an environment.

    The noise is drawn once per observation, at every step and reset, so the successor of a state
    and the state that follows it are the same noisy observation, as with a real sensor.
    Environments that are not reset keep their noise. The transform is only for environments: a
    replay buffer would draw new noise, for :math:`s` and not for :math:`s'`.

    The paper states a "scale" of its white noise (Kobayashi, L2C2, 2022, "Setup"), here the
    standard deviation of a Gaussian [inferred]. The noise leaves the bounds of the observations, so
    their spec becomes unbounded.

    Args:
        scale: standard deviation of the noise, in units of the observation, finite and at least 0;
            a number, or a tensor that broadcasts to the observation. Larger values make the task
            harder; the paper uses 0.01 and 0.001.
        in_keys: the observations to perturb. Defaults to ``["observation"]``; other entries, such
            as the episode's reward sum, stay exact unless named.
        generator: source of the randomness, on the device of the observations, saved and restored
            with the ``state_dict`` of the environment. Defaults to PyTorch's global generator.
            TorchRL gives the seed of ``env.set_seed`` to the simulator and not to transforms: seed
            a generator, or call :func:`torch.manual_seed`. In a
            :class:`~torchrl.envs.ParallelEnv`, ``set_seed`` seeds each worker's global generator
            differently; a generator made in the environment's constructor is the same in all.

    Raises:
        TypeError: if ``scale`` or ``generator`` is of another type, or, when an environment takes
            the transform, if an observation is not floating point.
        ValueError: if ``scale`` is negative or not finite, or, when an environment takes the
            transform, does not broadcast to an observation; in use, if it is given transitions, as
            in a replay buffer.
        KeyError: when an environment takes the transform, if it has no such observation.

    Examples:
        >>> import torch
        >>> from torchrl.envs import GymEnv, TransformedEnv
        >>> from torchrl_l2c2 import ObservationNoise
        >>> noise = ObservationNoise(scale=0.01, generator=torch.Generator().manual_seed(0))
        >>> env = TransformedEnv(GymEnv("Pendulum-v1"), noise)
        >>> rollout = env.rollout(10)
        >>> torch.equal(rollout["next", "observation"][:-1], rollout["observation"][1:])
        True
    """

    def __init__(
        self,
        scale: float | Tensor,
        in_keys: Sequence[NestedKey] | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        in_keys = ["observation"] if in_keys is None else in_keys
        super().__init__(in_keys=in_keys, out_keys=in_keys, generator=generator)
        several = hasattr(scale, "__len__") and not isinstance(scale, str)
        for entry in torch.as_tensor(scale).flatten().tolist() if several else [scale]:
            check_real("scale", entry, at_least=0)
        scale = torch.as_tensor(scale, dtype=torch.get_default_dtype())
        # A setting, not a state: a checkpoint must not overrule it.
        self.register_buffer("scale", scale, persistent=False)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Adds noise to observations without a successor, of any batch size."""
        if "next" in tensordict.keys():
            raise ValueError(
                "ObservationNoise belongs to an environment, not to a replay buffer: of a "
                "transition it would move the state and not the next one. Put it into a "
                "TransformedEnv."
            )
        return super().forward(tensordict)

    def _apply_transform(self, obs: Tensor) -> Tensor:
        noise = torch.randn(obs.shape, generator=self.generator, dtype=obs.dtype, device=obs.device)
        # In place: the observation keeps its dtype.
        return noise.mul_(self.scale).add_(obs)

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return self._call(tensordict_reset)

    def _check_environment(self, env: EnvBase) -> None:
        # TorchRL works specs out when they are first asked for, which may be after a step.
        self.transform_observation_spec(env.observation_spec.clone())

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        for key in self.in_keys:
            if key not in observation_spec.keys(True, True):
                raise KeyError(
                    f"ObservationNoise finds no observation {key!r}; the environment has "
                    f"{listed(observation_spec)}. Name those to perturb in in_keys."
                )
            spec = observation_spec[key]
            self._check_leaf(key, spec.dtype, spec.shape)
            observation_spec[key] = Unbounded(spec.shape, device=spec.device, dtype=spec.dtype)
        return observation_spec

    def _check_leaf(self, key: NestedKey, dtype: torch.dtype, shape: torch.Size) -> None:
        if not dtype.is_floating_point:
            raise TypeError(
                f"ObservationNoise needs floating-point observations, {key!r} has dtype {dtype}: "
                "convert it with a transform before this one, or leave it out of in_keys."
            )
        trailing = shape[len(shape) - self.scale.ndim :]
        if self.scale.ndim > len(shape) or any(
            size not in (1, full) for size, full in zip(self.scale.shape, trailing, strict=True)
        ):
            raise ValueError(
                f"scale of shape {tuple(self.scale.shape)} does not broadcast to the observation "
                f"{key!r} of shape {tuple(shape)}."
            )

    def __repr__(self) -> str:
        return f"{type(self).__name__}(scale={self.scale.tolist()}, keys={self.in_keys})"
