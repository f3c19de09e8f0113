"""Processes of a session, for the benchmarks that end processes."""

from __future__ import annotations

import os
from pathlib import Path


def living(session: int) -> list[int]:
    """Return the processes of a session that live, the first included."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            state = (path / "stat").read_text().rpartition(")")[2].split()[0]
            if os.getsid(int(path.name)) == session and state != "Z":
                found.append(int(path.name))
        except (OSError, ValueError):
            continue
    return found
