"""Files that survive: atomic writing, checksums, locks, signals, checkpoints."""

__all__: list[str] = []  # what is public is exported by torchrl_hmcts.trainers
