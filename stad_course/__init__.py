"""What a course adds to the lessons: checks of the exercises, and a competition."""
