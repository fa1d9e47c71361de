"""What the map answers: ranked instances, labels, pictures."""
