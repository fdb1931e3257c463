"""Live: samples from a stream → the loop → pose, page, terminal, streams and a recording."""
