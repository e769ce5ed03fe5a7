"""Checks of the exercises: one module for each notebook, and what they share."""

from stad_course.checks.answers import Unsolved

__all__ = ["Unsolved"]
