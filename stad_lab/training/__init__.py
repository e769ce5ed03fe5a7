"""How V, M and C are trained."""
