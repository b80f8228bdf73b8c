"""`python -m skyquilt`: the same as the command `skyquilt`."""

from skyquilt.cli.main import run

if __name__ == "__main__":
    run()
