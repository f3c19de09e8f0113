"""The hook that makes any off-policy trainer of TorchRL train skills."""

from __future__ import annotations

from typing import Any

from tensordict.utils import NestedKey
from torchrl.trainers import Trainer, TrainerHookBase

from torchrl_hmcts.transforms import SkillReward


class SkillRewardHook(TrainerHookBase):
    r"""Rewards a trainer's samples by the objective of its own loss.

    It appends a :class:`~torchrl_hmcts.transforms.SkillReward` to the trainer's replay buffer. Use
    it where loss and buffer are built apart, as TorchRL's trainer configs do; where both are at
    hand, pass the transform to the buffer.

    Args:
        intrinsic_coeff (float): weight of the objective's reward. Default ``1.0``.
        extrinsic_coeff (float): weight of the env's reward. Default ``0.0``.
        reward_key (NestedKey): reward to write, ``[*B, 1]``, under ``"next"``. Default
            ``"reward"``.

    Raises:
        ValueError: on registering, if the loss has no objective or the trainer no replay buffer.

    Examples:
        >>> from torchrl_hmcts.trainers import SkillRewardHook
        >>> hook = SkillRewardHook(extrinsic_coeff=0.5)  # SACTrainerConfig(hooks=[hook], ...)
    """

    def __init__(
        self,
        *,
        intrinsic_coeff: float = 1.0,
        extrinsic_coeff: float = 0.0,
        reward_key: NestedKey = "reward",
    ) -> None:
        self._keywords: dict[str, Any] = {
            "intrinsic_coeff": intrinsic_coeff,
            "extrinsic_coeff": extrinsic_coeff,
            "reward_key": reward_key,
        }

    def register(self, trainer: Trainer, name: str = "skill_reward") -> None:
        """Append the transform to the trainer's replay buffer; the hook itself has no state."""
        objective = getattr(trainer.loss_module, "objective", None)
        buffer = getattr(trainer, "replay_buffer", None)
        if objective is None or buffer is None:
            raise ValueError(
                "SkillRewardHook needs a replay buffer and a loss with an objective, e.g. "
                f"DIAYNLoss; the trainer has a {type(trainer.loss_module).__name__} and "
                f"replay_buffer={buffer!r}."
            )
        buffer.append_transform(SkillReward(objective, **self._keywords))

    def state_dict(self) -> dict[str, Any]:
        """Return nothing: the transform has no state of its own."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Load nothing."""
