"""Atari games: emulators, their memory as observation, and options in processes."""
