"""Experiments that ``hmcts train`` runs, each a configuration and a function."""

from __future__ import annotations

from torchrl_hmcts.trainers.experiments.registry import EXPERIMENTS, Experiment, find_experiment

__all__ = ["EXPERIMENTS", "Experiment", "find_experiment"]
