"""What a course adds: predictions and quizzes, checks of the exercises, and a competition."""
