"""`python -m skyquilt`."""

from skyquilt.cli.main import run

if __name__ == "__main__":
    run()
