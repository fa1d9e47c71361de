"""The voxel hash and the pooled storage of embedding rows."""
