"""DeepMind Lab's random maze: our simulator, and the engine itself."""

__all__: list[str] = []  # what is public is exported by torchrl_hmcts.envs
