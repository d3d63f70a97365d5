"""How a loss lets others see what its networks give at the batch's own states."""

from __future__ import annotations

from tensordict import TensorDictBase

from torchrl_l2c2.objectives.mixin import LossMixin


class SharedEvaluation(LossMixin):
    """A loss that evaluates its networks at the batch's states through one method.

    A loss that inherits from this class, and evaluates its networks with
    :meth:`evaluate_at_batch`, is spared a second evaluation by every regularizer around it:
    :class:`RegularizedLoss` overrides the method, keeps what it returns until the forward pass is
    done, and evaluates the network at the other states alone. :class:`PPORPELoss` is such a loss.

    A loss that does not inherit from it works as well; its networks are evaluated once more.

    Examples:
        >>> from torchrl.objectives import DDPGLoss
        >>> from torchrl_l2c2.objectives import SharedEvaluation
        >>> class ThriftyLoss(DDPGLoss, SharedEvaluation):
        ...     def evaluate_at_batch(self, network, tensordict):
        ...         net = getattr(self, network)
        ...         with getattr(self, f"{network}_params").to_module(net):
        ...             return net(tensordict.select(*net.in_keys))
        ...
        ...     def loss_value(self, tensordict):
        ...         value = self.evaluate_at_batch("value_network", tensordict)
        ...         return value["state_action_value"].square().mean(), {}
    """

    def evaluate_at_batch(self, network: str, tensordict: TensorDictBase) -> TensorDictBase:
        """What a network writes, or the parameters of its distribution, at the batch's states.

        Must depend on the given tensordict alone: compiled, it may be called with the rows of
        other states beside those of the batch.

        Args:
            network (str): its name, such as ``"actor_network"``.
            tensordict (TensorDictBase): the batch, ``[*B]``.

        Returns:
            TensorDictBase: the outputs, ``[*B]``; for a stochastic policy what
            ``get_dist_params`` returns.
        """
        raise NotImplementedError
