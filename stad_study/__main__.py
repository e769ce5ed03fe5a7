"""`python -m stad_study`: the command line of `stad_study.cli`."""

from stad_lab.streams import run_program

if __name__ == "__main__":
    run_program("stad_study", progress=("replicate", "evaluate", "latents", "probe"))
