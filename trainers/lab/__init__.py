"""What the experiment in DeepMind Lab's maze is made of: envs, training, tests, a script."""
