"""Parts of the trainers of skills: data, rounds, curves, coverage, control, growth."""

__all__: list[str] = []  # what is public is exported by torchrl_hmcts.trainers
