"""What the experiment in DeepMind Lab's maze is made of: envs, training, tests, a script."""

__all__: list[str] = []  # what is public is exported by torchrl_hmcts.trainers
