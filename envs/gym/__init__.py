"""Gymnasium envs that can be set to any state, and the snapshots that do it."""

__all__: list[str] = []
