"""The seat at the wheel."""
