"""What the node says about itself: status and diagnostics."""
