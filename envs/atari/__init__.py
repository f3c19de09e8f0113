"""Atari games: emulators, their memory as observation, and options in processes."""

__all__: list[str] = []  # what is public is exported by torchrl_hmcts.envs
