"""A competition for a class: submitted agents on hidden tracks, each in a process of its own.

Read `drive.py` first, then `process.py` and `child.py`, the two ends of a pipe. The parent drives
the cars and counts the points. The child is shown pictures and answers with actions.
"""
