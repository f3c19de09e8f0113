"""Files that survive: atomic writing, checksums, locks, signals, checkpoints."""
