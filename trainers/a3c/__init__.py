"""Parts of asynchronous training: learners, their processes, shared optimisers, the log."""

__all__: list[str] = []  # what is public is exported by torchrl_hmcts.trainers
