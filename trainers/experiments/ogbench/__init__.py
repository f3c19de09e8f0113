"""OGBench's mazes and puzzles from recorded episodes alone: options and plans, offline."""

__all__: list[str] = []  # `hmcts train kit=ogbench` and `hmcts data` are its face
