"""Parts of the experiments in Waterworld's mazes: envs, networks, tests, an expert."""

__all__: list[str] = []  # what is public is exported by torchrl_hmcts.trainers
