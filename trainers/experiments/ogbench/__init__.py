"""OGBench's point mazes from recorded episodes alone: options, their model and plans, offline."""
