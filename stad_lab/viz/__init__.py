"""Figures, films and widgets."""
