"""Parts of the node: life cycle, threads, parameters, and the session with models and map."""
