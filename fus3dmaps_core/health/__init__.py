"""What is wrong with the inputs or the mapping, in words."""
