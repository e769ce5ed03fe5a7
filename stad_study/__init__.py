"""The experiments of the replication, and what came out."""
