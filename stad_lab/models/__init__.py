"""V, M and C: the networks and their losses."""
