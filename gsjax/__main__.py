"""`python -m gsjax` is `gsjax`."""

from gsjax.cli import entry

if __name__ == "__main__":  # not when a subprocess imports the module
    entry()
