"""Random mazes: layouts, Waterworld, a gridworld, pictures."""
