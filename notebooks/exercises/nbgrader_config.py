"""The course for nbgrader, which reads this file when it is called in this folder."""

from pathlib import Path

from nbgrader.preprocessors import (
    CheckCellMetadata,
    ClearOutput,
    DeduplicateIds,
    OverwriteCells,
    OverwriteKernelspec,
)


class DropRepeated(DeduplicateIds):
    """Takes a cell that a student has copied or split as one of the student's own.

    nbgrader empties its metadata, takes that for an old notebook's, and leaves this student and all
    after it ungraded.
    """

    def preprocess_cell(self, cell, resources, cell_index):
        """Drop the metadata of a repeated cell."""
        cell, resources = super().preprocess_cell(cell, resources, cell_index)
        if cell.metadata.get("nbgrader") == {}:
            del cell.metadata["nbgrader"]
        return cell, resources


c = get_config()  # noqa: F821 (nbgrader runs this file with get_config in its globals)

c.CourseDirectory.course_id = "stad_lab"
c.CourseDirectory.root = str(Path(__file__).parent)
c.ClearSolutions.code_stub = {"python": 'raise Unsolved("replace this line with your code")'}
c.ClearSolutions.text_stub = "*Write your answer here.*"
c.ExecutePreprocessor.timeout = 600  # seconds for a cell: weak machines, and students' loops
c.Autograde.sanitize_preprocessors = [
    ClearOutput,
    DropRepeated,
    OverwriteKernelspec,
    OverwriteCells,
    CheckCellMetadata,
]
