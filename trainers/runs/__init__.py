"""Runs: their folder, configuration, curves, worker files and sweeps."""

__all__: list[str] = []  # what is public is exported by torchrl_hmcts.trainers
