"""What the node is made of: life cycle, threads, parameters, the session."""
