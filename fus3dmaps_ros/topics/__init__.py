"""Topics of the node: subscriptions, publishers and message conversions."""
