"""What the trainers of skills are made of: data, curves, coverage, growth, terminations."""

__all__: list[str] = []  # what is public is exported by torchrl_hmcts.trainers
