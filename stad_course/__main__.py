"""`python -m stad_course`: the command line of `stad_course.cli`."""

from stad_lab.streams import run_program

if __name__ == "__main__":
    run_program("stad_course", progress=())
