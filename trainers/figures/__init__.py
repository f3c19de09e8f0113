"""Pictures and pages of runs, by the dissertation's figures."""
