"""DeepMind Lab's random maze: our simulator, and the engine itself."""
