"""Print the marks of an assignment that nbgrader has graded, as CSV: python marks.py 01_difference_images.

Run it in the folder of the course, where nbgrader keeps its gradebook. The machine's points count half, because the
checks and the model answers are public; the points that a person has given count in full.
"""

import sys

from nbgrader.api import Gradebook


def marks(gradebook: Gradebook, name: str) -> dict[str, tuple[float, float]]:
    """The points of an assignment: student -> (the machine's, a person's). A person's word replaces the machine's."""
    found = {}
    for submission in gradebook.notebook_submissions(name, name):
        machine = sum(grade.auto_score or 0.0 for grade in submission.grades if grade.manual_score is None)
        person = sum(grade.manual_score or 0.0 for grade in submission.grades)
        found[submission.student.id] = machine, person
    return found


if __name__ == "__main__":
    with Gradebook("sqlite:///gradebook.db") as gradebook:
        print("student,machine,person,mark")
        for student, (machine, person) in sorted(marks(gradebook, sys.argv[1]).items()):
            print(student, machine, person, machine / 2 + person, sep=",")
