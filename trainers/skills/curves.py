"""The names under which training curves are logged, those of the dissertation's figures 4.6 to 4.9.

The losses keep TorchRL's names, which begin with ``loss``; ``DIAYNTrainer`` has the table.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase


def curve_name(key: str) -> str:
    """Return the name under which an entry of a loss's output is logged.

    Example:
        >>> [curve_name(key) for key in ("loss_actor", "qvalue_loss_0", "loss_qvalue", "entropy")]
        ['actor_loss', 'critic_1_loss', 'critic_loss', 'entropy']
    """
    if key == "loss_qvalue":
        return "critic_loss"
    if key.startswith("qvalue_loss_"):
        return f"critic_{int(key.rsplit('_', 1)[1]) + 1}_loss"
    if key.startswith("loss_"):
        return f"{key.removeprefix('loss_')}_loss"
    return key


def log_curves(optim_steps: int, average_losses: TensorDictBase | None) -> dict[str, float]:
    """Name the losses and diagnostics of a batch, averaged over its updates, for the log.

    A hook of any TorchRL ``Trainer`` for the stage ``"post_optim_complete_log"``; turn off the
    Trainer's own ``auto_log_optim_steps`` with it.
    """
    values: dict[str, float] = {"optim_steps": optim_steps}
    if average_losses is not None:
        names = [curve_name(key) for key in average_losses.keys()]
        # One stack and one copy for all of them.
        values.update(zip(names, torch.stack(list(average_losses.values())).tolist(), strict=True))
    return values


class Curves(dict[str, list[float]]):
    """Curves by their names; the loss's own names find them as well."""

    def __missing__(self, key: str) -> list[float]:
        name = curve_name(key)
        if name == key:
            raise KeyError(f"{key!r} was not logged; there are {sorted(self)}.")
        return self[name]
