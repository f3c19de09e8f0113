"""Runs: their folder, configuration, curves, worker files and sweeps."""
