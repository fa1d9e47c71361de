"""Reports of the node about itself: status and diagnostics."""
