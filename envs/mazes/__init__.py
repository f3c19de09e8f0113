"""Random mazes: layouts, Waterworld, a gridworld, pictures."""

__all__: list[str] = []  # what is public is exported by torchrl_hmcts.envs
