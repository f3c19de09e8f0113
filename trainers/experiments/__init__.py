"""Experiments that ``hmcts train`` runs, each a configuration and a function."""

__all__: list[str] = []  # `registry` has them by name
