"""Files that survive, and who computes."""
