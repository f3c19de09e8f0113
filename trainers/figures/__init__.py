"""Pictures and pages of runs, by the dissertation's figures."""

__all__: list[str] = []  # what is public is exported by torchrl_hmcts.trainers
