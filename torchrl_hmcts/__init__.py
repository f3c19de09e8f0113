"""Hierarchical Monte Carlo tree search over learned skills, as TorchRL components."""

__version__ = "0.1.0"
