"""`python -m gsjax.cli` is `gsjax`."""

from gsjax.cli import entry

if __name__ == "__main__":  # and not where a process that it started looks for its functions
    entry()
