"""The hierarchical agent on Atari: how it searches, and where its options come from."""

__all__: list[str] = []  # what is public is exported by torchrl_hmcts.trainers
