"""Print the marks of a graded assignment as CSV: python marks.py 01_difference_images.

Run it in the folder of the course, where nbgrader keeps its gradebook. The machine's points count
half, because the checks and the model answers are public; a person's points count in full. A mark
is final when `unread` is 0: so many answers of the student wait for a person.
"""

import argparse
import csv
import sys
from pathlib import Path

from nbgrader.api import Gradebook, MissingEntry


def points_by_hand(grade) -> float:
    """What a person gave for a cell: points, and extra credit."""
    return (grade.manual_score or 0.0) + (grade.extra_credit or 0.0)


def marks(gradebook: Gradebook, name: str) -> dict[str, tuple[float, float, int]]:
    """Points of an assignment: student -> (the machine's, a person's, number of unread answers).

    A person's points replace the machine's, and extra credit is a person's, too.
    """
    found = {}
    for submission in gradebook.notebook_submissions(name, name):
        machine = sum(
            grade.auto_score or 0.0 for grade in submission.grades if grade.manual_score is None
        )
        person = sum(map(points_by_hand, submission.grades))
        found[submission.student.id] = (
            machine,
            person,
            sum(grade.needs_manual_grade for grade in submission.grades),
        )
    return found


def manual_on_machine_cells(gradebook: Gradebook, name: str) -> list[tuple[str, str, float]]:
    """Points by hand where the machine grades: (student, cell, points).

    A person may have given them, but so may a submission: it runs on the account that grades, and
    can leave a process behind that edits gradebook.db.
    """
    notebook = gradebook.find_notebook(name, name)
    by_hand = {cell.name for cell in notebook.solution_cells}
    return [
        (submission.student.id, grade.name, points_by_hand(grade))
        for submission in gradebook.notebook_submissions(name, name)
        for grade in submission.grades
        if (grade.manual_score is not None or grade.extra_credit) and grade.name not in by_hand
    ]


def read_marks(name: str) -> dict[str, tuple[float, float, int]]:
    """The marks in this folder's gradebook; without it, or the assignment, the program ends."""
    if not Path("gradebook.db").exists():
        where = "go to the folder of the course, where nbgrader has graded"
        sys.exit(f"no gradebook.db in {Path.cwd()}: {where}")
    with Gradebook("sqlite:///gradebook.db") as gradebook:
        try:
            gradebook.find_assignment(name)
        except MissingEntry:
            known = ", ".join(assignment.name for assignment in gradebook.assignments)
            sys.exit(f"no assignment {name!r} in gradebook.db: choose one of {known}")
        for student, cell, points in manual_on_machine_cells(gradebook, name):
            told = f"has {points} points by hand on {cell!r}, which the machine grades"
            print(f"warning: {student} {told}: did a person give them?", file=sys.stderr)
        return marks(gradebook, name)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(
        description="Print the marks of an assignment that nbgrader has graded, as CSV."
    )
    parser.add_argument("name", help="of the assignment, for example 01_difference_images")
    found = read_marks(parser.parse_args().name)
    table = csv.writer(sys.stdout, lineterminator="\n")
    table.writerow(["student", "machine", "person", "mark", "unread"])
    for student, (machine, person, unread) in sorted(found.items()):
        table.writerow([student, machine, person, machine / 2 + person, unread])
