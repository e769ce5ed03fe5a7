"""The course for nbgrader: `nbgrader generate_assignment 01_difference_images` in this folder, and so on."""

from pathlib import Path

c = get_config()  # noqa: F821 (nbgrader runs this file with get_config in its globals)

c.CourseDirectory.course_id = "stad_lab"
c.CourseDirectory.root = str(Path(__file__).parent)
c.ClearSolutions.code_stub = {"python": 'raise NotImplementedError("not done yet: replace this line with your code")'}
c.ClearSolutions.text_stub = "*Write your answer here.*"
c.ExecutePreprocessor.timeout = 600  # seconds for a cell: weak machines, and students' loops
