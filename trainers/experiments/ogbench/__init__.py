"""OGBench's point mazes from recorded episodes alone: options, their model and plans, offline."""

__all__: list[str] = []  # `hmcts train kit=ogbench` and `hmcts data` are its face
