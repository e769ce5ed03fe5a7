"""Checks of the exercises: one module for each notebook, and what they share."""

from stad_course.checks.answers import Unsolved, WrongAnswer, ask, check

__all__ = ["Unsolved", "WrongAnswer", "ask", "check"]
