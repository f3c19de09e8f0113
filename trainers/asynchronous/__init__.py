"""What asynchronous training is made of: learners, their processes, shared optimisers, the log."""
