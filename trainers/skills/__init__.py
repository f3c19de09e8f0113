"""What the trainers of skills are made of: data, curves, coverage, growth, terminations."""
