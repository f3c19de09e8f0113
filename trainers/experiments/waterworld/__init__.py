"""What the experiments in Waterworld's mazes are made of: envs, networks, tests, an expert."""

__all__: list[str] = []  # what is public is exported by torchrl_hmcts.trainers
