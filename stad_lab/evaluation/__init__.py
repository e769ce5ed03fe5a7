"""How good V, M and the agent are."""
