"""Trainers, experiments and the command line."""
