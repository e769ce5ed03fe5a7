"""`python -m stad_lab`: the command line of `stad_lab.cli`."""

from stad_lab.streams import run_program

if __name__ == "__main__":
    run_program("stad_lab", progress=("train", "fine-tune", "evaluate", "probe"))
