"""Trainers, experiments and the command line."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchrl_hmcts.trainers.config import DemoConfig
    from torchrl_hmcts.trainers.diayn import DIAYNTrainer

__all__ = ["DIAYNTrainer", "DemoConfig"]


def __getattr__(name: str) -> Any:
    # Imported when asked for: the command line answers --help without loading torch.
    if name == "DIAYNTrainer":
        from torchrl_hmcts.trainers.diayn import DIAYNTrainer

        return DIAYNTrainer
    if name == "DemoConfig":
        from torchrl_hmcts.trainers.config import DemoConfig

        return DemoConfig
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
