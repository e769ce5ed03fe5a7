"""What a course adds: a test of machines, driving by hand, quizzes, checks and a competition."""
