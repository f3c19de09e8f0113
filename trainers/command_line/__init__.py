"""The verbs of the command ``hmcts``, which ``torchrl_hmcts.trainers.cli`` joins."""

from __future__ import annotations

__all__: list[str] = []
