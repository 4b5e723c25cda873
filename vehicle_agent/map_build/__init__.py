"""Maps from recorded drives: movers and bodywork left out, poses closed in loops, and the result's quality."""
