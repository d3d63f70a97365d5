"""A hook with which TorchRL's trainers set the progress of a ramp."""

from __future__ import annotations

from typing import Any

from torchrl.trainers import Trainer, TrainerHookBase

from torchrl_l2c2.objectives import RegularizedLoss


class ProgressHook(TrainerHookBase):
    """Sets the progress of a trainer's loss after every batch, for the ramp of its penalty.

    The progress is the share of ``total_frames`` that is collected. The hook has no effect on a
    loss without a ramp. In a configuration of one of TorchRL's trainers it is an entry of
    ``hooks``: ``{_target_: torchrl_l2c2.ProgressHook}``.

    Examples:
        >>> from torchrl_l2c2 import ProgressHook
        >>> def with_progress(trainer):
        ...     ProgressHook().register(trainer)  # before trainer.train()
        ...     return trainer
    """

    def register(self, trainer: Trainer, name: str = "progress") -> None:
        """Sets the progress, and registers the hook at the trainer.

        Args:
            trainer (Trainer): the trainer.
            name (str): not used, because the hook has no state: the loss keeps the progress.

        Raises:
            TypeError: the trainer's loss has no regularizer.
        """
        loss = trainer.loss_module
        if not isinstance(loss, RegularizedLoss):
            raise TypeError(
                "ProgressHook sets the progress of a loss with a regularizer, and the trainer's "
                f"{type(loss).__name__} has none: wrap it, smooth(loss)."
            )

        def set_progress() -> None:
            loss.set_progress(trainer.collected_frames / trainer.total_frames)

        set_progress()
        trainer.register_op("post_steps", set_progress)

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        pass
