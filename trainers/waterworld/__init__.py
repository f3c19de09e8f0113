"""What the experiments in Waterworld's mazes are made of: envs, networks, tests, an expert."""
